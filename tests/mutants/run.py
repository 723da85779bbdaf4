"""Deliberate mistakes: does a test fail for each of them?

    make mutants                                          # a sample of 160 mistakes
    python tests/mutants/run.py --only jaxsfm/core/align.py --count 40
    python tests/mutants/run.py --only jaxsfm/core --again   # run what survived once more

A sample of small mistakes (`places.py`) is drawn from the core, the refinement, the registration
and the view graph: files get a share by their number of places, at least one each, and a seed fixes
which. For each mistake the tests of its module run in a copy of the package, quickest first, until
one fails. The working tree is never changed.

How to read the output. *Killed*: a test failed, or the package could not be imported, or the tests
took far longer than they should ("timed out"). *Survived*: all tests passed with the mistake in
place; each survivor is listed as file:line with the line before and after. It is either a gap in
the tests or a change that no test can see (a cache size, a guard that is never reached). The latter
are listed with a reason in `equivalent.json`, by the text of the line and not by its number, and
are counted on their own ("equivalent, explained"). The share of killed mistakes leaves them out.

Results are appended to `build/mutants/results.jsonl` and found again as long as the code of the
mutated file has not changed: a run that was interrupted goes on. A mistake that was killed stays
killed; `--again` repeats the ones that survived, after tests were added.

Every mistake runs in a process forked from this one, which has imported pytest and JAX but started
no backend, and all of them share one cache of compiled programs.
"""

import argparse
import hashlib
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from pathlib import Path
from typing import NamedTuple

from places import Edit, code, mistakes

ROOT = Path(__file__).resolve().parents[2]
BUILD = ROOT / "build" / "mutants"
EQUIVALENT = Path(__file__).parent / "equivalent.json"
FILES = (
    "jaxsfm/core",
    "jaxsfm/runs/run_photos.py",
    "jaxsfm/sfm/check",
    "jaxsfm/sfm/mapping.py",
    "jaxsfm/sfm/refine",
    "jaxsfm/sfm/refined_models.py",
    "jaxsfm/sfm/register",
    "jaxsfm/sfm/road.py",
    "jaxsfm/sfm/selected_stage.py",
    "jaxsfm/sfm/view_graph.py",
)
ALIGN = ("tests/core/test_align.py", "tests/core/test_alignment_noise.py")
NUMERICS, BACKBONES = "tests/core/test_numerics_and_grid.py", "tests/core/test_backbones.py"
PAIR, BATCHES = "tests/core/test_pair.py", "tests/matching/test_batches.py"
PRODUCTS, ROAD = "tests/core/test_products.py", "tests/sfm/test_road.py"
REFINE, WEAK = "tests/sfm/test_refine.py", "tests/sfm/test_weak_views.py"
CHECK, DEVICE = "tests/sfm/test_check_model.py", "tests/sfm/test_device_images.py"
TESTS: dict[str, tuple[str, ...]] = {
    "core/alexnet": (BACKBONES,),
    "core/align": ALIGN,
    "core/blocks": ("tests/core/test_blocks.py", "tests/core/test_vgg.py"),
    "core/bundle_layout": (
        "tests/core/test_bundle_step.py",
        "tests/core/test_band.py",
        "tests/core/test_bundle.py",
    ),
    "core/bundle_problem": ("tests/core/test_bundle_problem.py", "tests/core/test_bundle.py"),
    "core/cameras": ("tests/core/test_projections.py",),
    "core/features": ("tests/core/test_features.py", BACKBONES),
    "core/grid": (NUMERICS,),
    "core/interpolate": ALIGN,
    "core/levenberg_marquardt": ("tests/core/test_bundle.py",),
    "core/night": ("tests/core/test_night_model.py", "tests/core/test_views.py"),
    "core/numerics": (NUMERICS, PRODUCTS),
    "core/octaves": ("tests/core/test_octaves.py", PRODUCTS),
    "core/pair_shape": ("tests/core/test_presets.py", "tests/core/test_platforms.py"),
    "core/ransac": ("tests/core/test_ransac.py", "tests/core/test_planes.py"),
    "core/retrieval": ("tests/core/test_core_retrieval.py", "tests/core/test_partners.py"),
    "core/schur": ("tests/core/test_bundle.py",),
    "core/sharded": (BATCHES,),
    "core/types": ("tests/core/test_presets.py", PAIR),
    "core/winograd": ("tests/core/test_winograd.py", "tests/core/test_vgg.py"),
    "check/agreement": ("tests/sfm/test_check_agreement.py", CHECK),
    "check/common_places": ("tests/sfm/test_check_places.py", "tests/bench/test_outcomes.py"),
    "check/grouping": ("tests/sfm/test_check_grouping.py", "tests/sfm/test_doubt.py"),
    "check/pose_ambiguity": ("tests/sfm/test_check_places.py", CHECK),
    "check/check_model": (
        "tests/sfm/test_check_thinning.py",
        "tests/sfm/test_check_scale.py",
        CHECK,
        "tests/sfm/test_check_places.py",
    ),
    "check/model_check": ("tests/sfm/test_selected_stage.py", "tests/report/test_verdict.py"),
    "refine/candidates": (REFINE, WEAK),
    "refine/device_images": (
        DEVICE,
        "tests/sfm/test_pose_uncertainty.py",
        "tests/sfm/test_pair_alignment.py",
        REFINE,
    ),
    "refine/fixed_structure": (
        "tests/sfm/test_pose_search.py",
        "tests/sfm/test_most_views.py",
        WEAK,
    ),
    "refine/octave_pose": (
        "tests/sfm/test_pose_uncertainty.py",
        "tests/sfm/test_single_view.py",
        WEAK,
    ),
    "refine/patch_alignment": (DEVICE, REFINE, WEAK),
    "refine/pose_uncertainty": ("tests/sfm/test_pose_uncertainty.py",),
    "refine/pose_search": ("tests/sfm/test_pose_search.py",),
    "refine/one_pass": (REFINE, WEAK),
    "refine/passes": (REFINE, WEAK),
    "refine/plane_geometry": (REFINE, WEAK),
    "refine/track_alignment": (DEVICE, REFINE, WEAK),
    "refine/weak_views": (WEAK,),
    "register/grow": (
        "tests/sfm/test_new_points.py",
        "tests/sfm/test_registered_views.py",
        "tests/sfm/test_refused_places.py",
        "tests/runs/test_extend.py",
    ),
    "register/lost": ("tests/sfm/test_lost_views.py",),
    "register/locate_view": (
        "tests/sfm/test_single_view.py",
        "tests/sfm/test_new_points.py",
        "tests/runs/test_localize.py",
    ),
    "register/triangulate": ("tests/sfm/test_new_points.py",),
    "runs/run_photos": ("tests/runs/test_turned_photos.py", "tests/runs/test_run_photos.py"),
    "sfm/mapping": (ROAD, "tests/sfm/test_two_mappings.py"),
    "sfm/refined_models": ("tests/sfm/test_covisibility.py", "tests/sfm/test_refined_models.py"),
    "sfm/selected_stage": (
        "tests/sfm/test_selected_stage.py",
        "tests/sfm/test_split.py",
        ROAD,
    ),
    "sfm/view_graph": ("tests/sfm/test_viewgraph.py", "tests/sfm/test_pose_uncertainty.py"),
}
"""Module (last two parts of its path) -> the tests that should notice a mistake in it, quickest
first; otherwise tests/core/test_MODULE.py or tests/sfm/test_MODULE.py. A test_MODULE_laws.py of
either folder comes before them."""
LEFT_OUT: tuple[str, ...] = (
    "test_an_octave_is_the_smaller_image_described_alone",
    "test_more_room_changes_no_octave",
    "test_the_smallest_image_has_octaves_without_cells",
    "test_a_blank_image_has_nothing_to_centre",
    "test_features_are_the_programs_rounded_once",
)
"""Tests left out, by parts of their names. Quicker ones cover the same; the last one compares bits,
and programs compiled without optimizations round differently."""
EXAMPLES = 15
"""Most examples of a property test."""


_Plain = argparse.RawDescriptionHelpFormatter


class Outcome(NamedTuple):
    """What the tests said of one mistake."""

    verdict: str
    """"killed", "timed out" or "survived"."""
    seconds: float


def main() -> int:
    options = _options()
    texts = {path: (ROOT / path).read_text() for path in _files(options.only)}
    sample = _sample({p: mistakes(p, text) for p, text in texts.items()}, options)
    done = _results()
    known = {f"{e['file']} | {e['before']} | {e['after']}": e["why"] for e in _equivalent()}
    todo = []
    for edit in sample:
        outcome = done.get(_key(edit, texts))
        if outcome is None or (options.again and outcome.verdict == "survived"):
            todo.append(edit)
    _preload()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("mutants: stopped"))
    runner = _Runner(options.jobs)
    try:
        _without_mistakes(runner, todo, texts, done)
        for count, (_, edit, outcome) in enumerate(runner.run(todo, texts), start=1):
            done[_key(edit, texts)] = outcome
            _append({"key": _key(edit, texts), **outcome._asdict()})
            print(
                f"{count}/{len(todo)} {outcome.verdict} ({outcome.seconds:.0f} s) "
                f"{edit.path}:{edit.line} {edit.kind}",
                flush=True,
            )
    finally:
        runner.close()
    return _report(sample, [done[_key(e, texts)] for e in sample], known)


def _without_mistakes(
    runner: "_Runner", todo: list[Edit], texts: dict[str, str], done: dict[str, Outcome]
) -> None:
    """Make sure that tests pass without a mistake, and note how long they take."""
    sets = {_tests_of(edit.path): edit.path for edit in todo}
    if () in sets:
        raise SystemExit(f"mutants: {sets[()]} has no tests; see TESTS")
    state = hashlib.sha256()
    for path in sorted([*(ROOT / "tests").rglob("*.py"), *(ROOT / "jaxsfm").rglob("*.py")]):
        state.update(code(path.read_text()).encode())
    keys = {tests: f"no mistake | {' '.join(tests)} | {state.hexdigest()}" for tests in sets}
    new = [Edit(p, 0, "", 0, 0, "", "", "") for t, p in sets.items() if keys[t] not in done]
    for copy, edit, outcome in runner.run(new, texts):
        tests = _tests_of(edit.path)
        if outcome.verdict != "survived":
            print(*(copy / "log").read_text().splitlines()[-30:], sep="\n")
            raise SystemExit(f"mutants: {' '.join(tests)} fail without a mistake")
        done[keys[tests]] = outcome
        _append({"key": keys[tests], **outcome._asdict()})
        print(f"{' '.join(tests)}: {outcome.seconds:.0f} s without a mistake", flush=True)
    runner.usual = {tests: done[key].seconds for tests, key in keys.items()}


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=_Plain)
    parser.add_argument("--count", type=int, default=160, help="how many mistakes")
    parser.add_argument("--seed", type=int, default=0, help="which of them")
    parser.add_argument("--only", action="append", help="a file or folder; may be repeated")
    parser.add_argument("--jobs", type=int, default=2, help="how many at a time")
    parser.add_argument("--again", action="store_true", help="repeat what survived before")
    return parser.parse_args()


def _files(only: list[str] | None) -> list[str]:
    found = []
    for place in only or FILES:
        path = ROOT / place
        if not path.exists():
            raise SystemExit(f"mutants: there is no {place}")
        found += [path] if path.is_file() else sorted(path.rglob("*.py"))
    return [str(path.relative_to(ROOT)) for path in found]


def _sample(places: dict[str, list[Edit]], options: argparse.Namespace) -> list[Edit]:
    """The same number of mistakes for every run of a seed: shares by largest remainders."""
    places = {path: edits for path, edits in places.items() if edits}
    total = sum(map(len, places.values()))
    count = min(options.count, total)
    shares = {p: max(1.0, count * len(edits) / total) for p, edits in places.items()}
    numbers = {p: min(int(share), len(places[p])) for p, share in shares.items()}
    for p in sorted(shares, key=lambda p: int(shares[p]) - shares[p]):
        if sum(numbers.values()) < count and numbers[p] < len(places[p]):
            numbers[p] += 1
    sample = []
    for path, number in numbers.items():
        order = random.Random(f"{options.seed} {path}").sample(places[path], len(places[path]))
        sample += sorted(order[:number], key=lambda e: e.start)
    return sample


def _tests_of(path: str) -> tuple[str, ...]:
    parts, module = Path(path).parts, Path(path).stem
    usual = (f"tests/{parts[1]}/test_{module}.py",)
    laws = sorted(str(p.relative_to(ROOT)) for p in ROOT.glob(f"tests/*/test_{module}_laws.py"))
    tests = (*laws, *TESTS.get(f"{parts[-2]}/{module}", usual))
    return tuple(dict.fromkeys(t for t in tests if (ROOT / t).exists()))


def _key(edit: Edit, texts: dict[str, str]) -> str:
    """The edit and what its file does: comments and docstrings may change."""
    digest = hashlib.sha256(code(texts[edit.path]).encode()).hexdigest()[:12]
    return f"{edit.name} | {digest}"


def _results() -> dict[str, Outcome]:
    file = BUILD / "results.jsonl"
    lines = file.read_text().splitlines() if file.exists() else []
    records = [json.loads(line) for line in lines if line.endswith("}")]
    return {r["key"]: Outcome(r["verdict"], r["seconds"]) for r in records}


def _append(record: dict) -> None:
    BUILD.mkdir(parents=True, exist_ok=True)
    with (BUILD / "results.jsonl").open("a") as file:
        file.write(json.dumps(record) + "\n")


def _equivalent() -> list[dict[str, str]]:
    return json.loads(EQUIVALENT.read_text()) if EQUIVALENT.exists() else []


def _preload() -> None:
    """Import what every test needs, without starting a JAX backend: it survives no fork."""
    os.environ["PYTEST_XDIST_WORKER"] = "gw0"  # tests/conftest.py: no cache of its own
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(BUILD / "compiled")
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.1"
    os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = "1"  # compiling takes most of the time
    os.environ.setdefault("JAXSFM_DATA", str(ROOT.parent / "shared" / "data"))
    warnings.simplefilter("ignore")
    import beartype.door  # noqa: F401
    import cv2  # noqa: F401
    import flax.linen  # noqa: F401
    import hypothesis.extra.numpy  # noqa: F401
    import jax.numpy  # noqa: F401
    import jaxtyping  # noqa: F401
    import optax  # noqa: F401
    import pycolmap  # noqa: F401
    import scipy.optimize  # noqa: F401
    import scipy.spatial.transform  # noqa: F401


class _Fewer:
    """A pytest plugin: quick tests first; property tests of few examples, which are not shrunk."""

    def pytest_collection_modifyitems(self, items: list, config) -> None:
        import hypothesis

        phases = (hypothesis.Phase.explicit, hypothesis.Phase.generate)
        for item in items:
            name = "_hypothesis_internal_use_settings"
            own = getattr(item.obj, name, None)
            if own is not None:
                most = min(own.max_examples, EXAMPLES)
                fewer = dict(max_examples=most, derandomize=True, database=None, phases=phases)
                setattr(item.obj, name, hypothesis.settings(own, **fewer))
        kept = [item for item in items if not any(part in item.nodeid for part in LEFT_OUT)]
        items[:] = sorted(kept, key=lambda item: item.get_closest_marker("slow") is not None)


class _Runner:
    """Copies of the package, one for every job, in which processes run tests."""

    def __init__(self, jobs: int) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="jaxsfm-mutants-"))
        self.copies = [self.folder / str(k) for k in range(jobs)]
        ignored = shutil.ignore_patterns("__pycache__")
        for copy in self.copies:
            for name in ("jaxsfm", "tests", "weights_conversion"):
                shutil.copytree(ROOT / name, copy / name, ignore=ignored)
            shutil.copy(ROOT / "pyproject.toml", copy)
        self.usual: dict[tuple[str, ...], float] = {}
        """Seconds that tests take without a mistake."""

    def close(self) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)

    def run(self, edits: list[Edit], texts: dict[str, str]):
        """Yields each edit with the copy it ran in and its outcome, as they end."""
        waiting, free, running = list(reversed(edits)), list(self.copies), {}
        try:
            while waiting or running:
                while waiting and free:
                    edit, copy = waiting.pop(), free.pop()
                    _write(copy / edit.path, _with(texts[edit.path], edit))
                    tests = _tests_of(edit.path)
                    pid = _fork(copy, tests, copy / "log")
                    limit = time.monotonic() + 60 + 3 * self.usual.get(tests, 600)
                    running[pid] = (edit, copy, time.monotonic(), limit)
                time.sleep(0.05)
                for pid, (edit, copy, start, limit) in list(running.items()):
                    ended, status = os.waitpid(pid, os.WNOHANG)
                    late = not ended and time.monotonic() > limit
                    if not ended and not late:
                        continue
                    if late:
                        _stop(pid)
                    del running[pid]
                    free.append(copy)
                    _write(copy / edit.path, texts[edit.path])
                    verdict = "timed out" if late else "killed" if status else "survived"
                    yield copy, edit, Outcome(verdict, time.monotonic() - start)
        finally:
            for pid in running:
                _stop(pid)


def _with(text: str, edit: Edit) -> str:
    return text[: edit.start] + edit.new + text[edit.end :]


def _write(path: Path, text: str) -> None:
    """Replace a module and forget what it was compiled to."""
    path.write_text(text)
    for old in (path.parent / "__pycache__").glob(f"{path.stem}.*"):
        old.unlink()


def _stop(pid: int) -> None:
    os.killpg(pid, signal.SIGKILL)
    os.waitpid(pid, 0)


def _fork(copy: Path, tests: tuple[str, ...], log: Path) -> int:
    """The id of a process that runs the tests in a copy; it ends with 0 if all pass."""
    pid = os.fork()
    if pid:
        return pid
    status = 1
    try:
        os.setsid()
        os.chdir(copy)
        output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(output, 1)
        os.dup2(output, 2)
        sys.path[:] = [str(copy), str(copy / "tests"), *sys.path[1:]]
        sys.dont_write_bytecode = True
        import pytest

        arguments = ["-q", "-x", "--no-header", "-p", "no:cacheprovider", "-p", "no:xdist"]
        # Plugins were imported before pytest could rewrite their assertions; they make none.
        arguments += ["-W", "ignore::pytest.PytestAssertRewriteWarning"]
        status = int(pytest.main([*arguments, *tests], plugins=[_Fewer()]))
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def _report(sample: list[Edit], outcomes: list[Outcome], known: dict[str, str]) -> int:
    survivors, explained, table = [], [], {}
    for edit, outcome in zip(sample, outcomes, strict=True):
        row = table.setdefault(edit.path, {"killed": 0, "timed out": 0, "survived": 0, "equal": 0})
        why = known.get(f"{edit.path} | {edit.before} | {edit.after}")
        if outcome.verdict == "survived" and why:
            row["equal"] += 1
            explained.append((edit, why))
        else:
            row[outcome.verdict] += 1
            if outcome.verdict == "survived":
                survivors.append(edit)
    print(f"\n{'':<40} killed  timed out  survived  equivalent")
    for path, row in table.items():
        print(f"{path:<40} {row['killed']:6} {row['timed out']:10} {row['survived']:9}", end="")
        print(f" {row['equal']:11}")
    for edit, why in explained:
        print(
            f"\nequivalent: {edit.path}:{edit.line}\n  - {edit.before}\n  + {edit.after}\n  {why}"
        )
    for edit in survivors:
        print(f"\nsurvived: {edit.path}:{edit.line} ({edit.kind})")
        print(f"  - {edit.before}\n  + {edit.after}")
    late = sum(o.verdict == "timed out" for o in outcomes)
    counted = len(sample) - len(explained)
    killed = counted - len(survivors)
    print(
        f"\n{len(sample)} mistakes: {killed} killed (of these {late} timed out), {len(survivors)} "
        f"survived, {len(explained)} equivalent, explained. Killed: {killed / max(counted, 1):.1%}"
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
