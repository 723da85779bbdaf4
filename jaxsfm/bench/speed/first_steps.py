"""Run a newcomer's first commands, time them, and write a page about them.

    python -m jaxsfm.bench.speed.first_steps PHOTOS docs/first-steps.md

The program clones this repository into a new folder, runs the README's commands there, and then
reconstructs PHOTOS and exports the model to another tool's format. The page holds the commands,
what they printed and how long they took.
"""

import argparse
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[3]
STEPS = (
    (
        "From a clone to a report",
        (
            "git clone {root} jaxsfm",
            "cd jaxsfm && make demo",
            "ls jaxsfm/demo/run",
        ),
    ),
    (
        "From your own photos to a model in nerfstudio's format",
        (
            "ls photos | wc -l",
            "jaxsfm/.venv/bin/jaxsfm reconstruct photos --out model",
            "jaxsfm/.venv/bin/jaxsfm export model --to nerfstudio --out nerf --copy-images",
            "ls model nerf",
        ),
    ),
)
BAR = re.compile(r"(\w+): +\d+%\|")
"""A line of a progress bar. It is drawn many times; the page shows the last one."""
QUIET = {"PYTHONPATH": "", "COLUMNS": "100", "PIP_QUIET": "2"}


def shown(text: str, folder: Path) -> str:
    """The text that a terminal shows at the end, without this machine's folders."""
    text = text.replace("\x1b[A", "").replace(str(folder), "~").replace(str(ROOT), "jaxsfm.git")
    lines = [line.rstrip() for line in text.splitlines() if line.strip()]
    bars = {bar[1]: k for k, line in enumerate(lines) if (bar := BAR.match(line))}
    kept = (k for k, line in enumerate(lines) if not BAR.match(line) or k in bars.values())
    return "\n".join(lines[k] for k in kept)


def run_steps(photos: Path, folder: Path) -> list[str]:
    """Run all commands; returns the lines of the page. A command that fails ends the program."""
    shutil.copytree(photos, folder / "photos")
    lines = []
    for title, commands in STEPS:
        lines += [f"## {title}", ""]
        total = 0.0
        for command in commands:
            start = time.monotonic()
            done = subprocess.run(
                ["bash", "-c", command.format(root=ROOT)],
                cwd=folder,
                env={**os.environ, **QUIET},
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
            )
            seconds = time.monotonic() - start
            total += seconds
            said = shown(f"$ {command.format(root='jaxsfm.git')}\n{done.stdout}", folder)
            lines += ["```text", said, "```", "", f"{seconds:.0f} s.", ""]
            if done.returncode:
                raise SystemExit("\n".join([*lines, f"failed with {done.returncode}"]))
        lines += [f"Together {total / 60:.1f} minutes.", ""]
    return lines


def main() -> None:
    """Write the page."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("photos", type=Path)
    parser.add_argument("page", type=Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="first-steps-") as scratch:
        lines = run_steps(args.photos.resolve(), Path(scratch))
    head = [
        "# First steps",
        "",
        "This page shows what somebody new types, what the commands print, and how long they take. "
        "It was written by",
        "`python -m jaxsfm.bench.speed.first_steps PHOTOS PAGE` on "
        f"{os.cpu_count()} CPU cores, no GPU, Python {platform.python_version()}. "
        f"The photos are those of {args.photos.resolve().parent.name}.",
        "",
    ]
    args.page.write_text("\n".join([*head, *lines]))


if __name__ == "__main__":
    sys.exit(main())
