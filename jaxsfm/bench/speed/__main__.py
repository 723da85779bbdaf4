"""`python -m jaxsfm.bench.speed` prints a table; with --gate it compares with the baseline."""

import json
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated

from jaxsfm.io.libraries import usable_cores

# Set before JAX starts: both sides of every comparison use the cores that this process may use.
os.environ.setdefault("OMP_NUM_THREADS", str(usable_cores()))
os.environ.setdefault("GLOG_minloglevel", "2")  # COLMAP prints every step otherwise

import tyro

from jaxsfm.bench.figures import write_json
from jaxsfm.bench.speed import batches, extraction, homographies, machine, matching, scaling
from jaxsfm.bench.speed.timing import Metric

DATA = Path(os.environ.get("JAXSFM_DATA", "../shared/data"))
BASELINE = Path(__file__).parent / "baseline.json"


def groups(data: Path) -> dict[str, Callable[[], Iterator[Metric]]]:
    """The groups of measurements by name."""
    return {
        "machine": machine.measure,
        "extraction": extraction.measure,
        "mutual": matching.measure_mutual,
        "pairs": lambda: matching.measure_pairs(data),
        "homographies": homographies.measure,
        "batches": batches.measure,
        "scaling": lambda: scaling.measure_pairs(data),
        "pixels": lambda: scaling.measure_pixels(data),
        "stage": lambda: scaling.measure_stage(data),
    }


def line(metric: Metric) -> str:
    """A row of the table as text."""
    spread = f"+-{metric.spread:4.0%}" if metric.spread else ""
    return f"{metric.name:40s} {metric.value:12.4g} {metric.unit:16s} {spread}"


def worse(metric: Metric, baseline: float) -> bool:
    """Whether a figure is worse than the baseline by more than its tolerance."""
    if metric.tolerance is None:
        return False
    if metric.better == "higher":
        return metric.value < baseline * (1 - metric.tolerance)
    return metric.value > baseline * (1 + metric.tolerance)


def main(
    only: Annotated[tuple[str, ...], tyro.conf.arg(metavar="GROUP")] = (),
    gate: bool = False,
    update: bool = False,
    data: Path = DATA,
    json_file: Annotated[Path | None, tyro.conf.arg(name="json")] = None,
) -> int:
    """Measure speed, and accuracy with it.

    Args:
      only: groups: machine, extraction, mutual, pairs, homographies, batches, scaling, pixels,
        stage; all by default.
      gate: exit with 1 if a ratio is worse than the baseline by more than its tolerance.
      update: write a new baseline.
      data: folder of the data sets; groups that need a missing set are skipped.
      json_file: write all figures to this file.
    """
    known = groups(data)
    unknown = sorted(set(only) - set(known))
    if unknown:
        print(f"benchmarks: --only {unknown[0]}: not one of {', '.join(known)}", file=sys.stderr)
        return 2
    metrics = []
    for name in only or known:
        for metric in known[name]():
            print(line(metric), flush=True)
            metrics.append(metric)
    figures = {metric.name: metric.value for metric in metrics}
    if json_file is not None:
        write_json(json_file, {"metrics": [metric._asdict() for metric in metrics]})
    baseline = json.loads(BASELINE.read_text(encoding="utf-8")) if BASELINE.exists() else {}
    if update:
        write_json(BASELINE, baseline | figures)
        return 0
    if not gate:
        return 0
    lost = [m for m in metrics if m.name in baseline and worse(m, baseline[m.name])]
    for metric in lost:
        print(f"worse: {metric.name}: {metric.value:.4g}, baseline {baseline[metric.name]:.4g}")
    return 1 if lost else 0


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
