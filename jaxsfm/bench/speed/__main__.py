"""`python -m jaxsfm.bench.speed`: the table; with --gate a comparison with the baseline."""

import json
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated

# Before JAX starts: both sides of every comparison use the cores this process may use.
os.environ.setdefault("OMP_NUM_THREADS", str(len(os.sched_getaffinity(0))))
os.environ.setdefault("GLOG_minloglevel", "2")  # COLMAP tells of every step

import tyro

from jaxsfm.bench.speed import extraction, homographies, machine, matching, scaling
from jaxsfm.bench.speed.timing import Metric

DATA = Path(os.environ.get("JAXSFM_DATA", "../shared/data"))
BASELINE = Path(__file__).parent / "baseline.json"


def groups(data: Path) -> dict[str, Callable[[], Iterator[Metric]]]:
    """What can be measured, by name."""
    return {
        "machine": machine.measure,
        "extraction": extraction.measure,
        "mutual": matching.measure_mutual,
        "pairs": lambda: matching.measure_pairs(data),
        "homographies": homographies.measure,
        "scaling": lambda: scaling.measure_pairs(data),
        "pixels": lambda: scaling.measure_pixels(data),
        "start": lambda: scaling.measure_start(data),
        "stage": lambda: scaling.measure_stage(data),
    }


def line(metric: Metric) -> str:
    """A row of the table."""
    spread = f"+-{metric.spread:4.0%}" if metric.spread else ""
    return f"{metric.name:40s} {metric.value:12.4g} {metric.unit:16s} {spread}"


def worse(metric: Metric, baseline: float) -> bool:
    """Whether a figure lost more than its tolerance."""
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
    """Measure speed, with accuracy beside it.

    Args:
      only: groups: machine, extraction, mutual, pairs, homographies, scaling, pixels, start, stage;
        all by default.
      gate: exit with 1 if a ratio lost more than its tolerance against the baseline.
      update: write the baseline.
      data: folder of the data sets; what needs them is skipped without.
      json_file: where to write the figures.
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
        json_file.write_text(json.dumps([m._asdict() for m in metrics], indent=1) + "\n")
    baseline = json.loads(BASELINE.read_text()) if BASELINE.exists() else {}
    if update:
        BASELINE.write_text(json.dumps(baseline | figures, indent=1) + "\n")
        return 0
    if not gate:
        return 0
    lost = [m for m in metrics if m.name in baseline and worse(m, baseline[m.name])]
    for metric in lost:
        print(f"worse: {metric.name}: {metric.value:.4g}, baseline {baseline[metric.name]:.4g}")
    return 1 if lost else 0


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
