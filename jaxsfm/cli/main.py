"""The command line: it parses arguments, runs a command, and reports a failure in one sentence."""

import io
import logging
import os
import sys
import threading

import tyro

from jaxsfm.cli.arguments import unwrapped
from jaxsfm.cli.bench_commands import bench, data
from jaxsfm.cli.doctor_command import doctor
from jaxsfm.cli.export_commands import export
from jaxsfm.cli.model_commands import evaluate, extend, localize, merge, refine, report, view
from jaxsfm.cli.network_commands import train, weights, with_action
from jaxsfm.cli.old_options import current
from jaxsfm.cli.run_commands import demo, frames, match, pairs, reconstruct
from jaxsfm.errors import UserError
from jaxsfm.io import interrupt
from jaxsfm.io.libraries import keep_compiled, package_versions

DESCRIPTION = """Structure-from-Motion from dense VGG-16 features with relocalization.

For example
    $ jaxsfm demo
    $ jaxsfm reconstruct PHOTOS --out OUT

jaxsfm --version prints the version of jaxsfm and of the packages that its results depend on.
jaxsfm --tyro-print-completion bash (or zsh, tcsh) prints a script that lets your shell complete
commands and options."""
COMMANDS = {
    "reconstruct": reconstruct,
    "frames": frames,
    "match": match,
    "pairs": pairs,
    "localize": localize,
    "extend": extend,
    "refine": refine,
    "merge": merge,
    "evaluate": evaluate,
    "report": report,
    "view": view,
    "export": export,
    "demo": demo,
    "doctor": doctor,
    "weights": weights,
    "train": train,
    "data": data,
    "bench": bench,
}
UNREAD = 128 + 13
"""The exit status if nobody reads the output: what a shell says of a program that SIGPIPE ends."""
NO_MEMORY = ("RESOURCE_EXHAUSTED", "can't start new thread")
"""What exceptions of other types say if there is not enough memory."""
for _command in COMMANDS.values():
    unwrapped(_command)


def version_lines() -> list[str]:
    """The version of jaxsfm, and the versions of the packages that its results depend on."""
    found = package_versions()
    lines = [f"jaxsfm {found.pop('jaxsfm')}"]
    return lines + [f"  {name} {version}" for name, version in found.items()]


def _print_any_name() -> None:
    """Print characters that the terminal cannot show as escapes, and not raise an error.

    Where output goes into a file or a pipe, Windows's own encoding lacks most letters of the world.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="backslashreplace")


def main(argv: list[str] | None = None) -> int:
    """Run one command.

    Args:
      argv: arguments without the program's name; None: those of this process.

    Returns:
      The exit status: 0 for success, 1 for a command that found no solution, 2 for arguments or
      files that cannot be used, 3 for a model that may be wrong (`reconstruct`), 130 after Ctrl-C
      or SIGTERM, 141 if nobody reads what it prints any more (`jaxsfm ... | head`).
    """
    _print_any_name()
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("jaxsfm: %(message)s"))
    logger = logging.getLogger("jaxsfm")
    logger.handlers, logger.propagate = [handler], False
    logger.setLevel(logging.INFO)
    keep_compiled()
    try:
        return _reported(sys.argv[1:] if argv is None else argv)
    except BrokenPipeError:
        # Programs of Unix end without a word then, by the signal SIGPIPE, which Python ignores.
        # What is still to be written goes nowhere: Python would report an error at its end.
        with open(os.devnull, "wb") as nowhere:
            for stream in (sys.stdout, sys.stderr):
                if stream is not None:
                    os.dup2(nowhere.fileno(), stream.fileno())
        return UNREAD


def _reported(argv: list[str]) -> int:
    """Run one command, and report a failure in one sentence."""
    try:
        with interrupt.noted():
            return _run(argv)
    except UserError as error:
        print(f"jaxsfm: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(
            "jaxsfm: interrupted. Finished work of reconstruct is kept, and the same command "
            "continues it; finished rows of bench are in the --json file",
            file=sys.stderr,
        )
        if any(thread.name == "jaxsfm-colmap" for thread in threading.enumerate()):
            # The global mapper cannot be stopped. If its native code still ran while the
            # interpreter shuts down, the process would abort.
            sys.stdout.flush()
            os._exit(130)
        return 130
    except BrokenPipeError:
        raise
    except OSError as error:
        named = f"{error.filename}: " if error.filename else ""
        print(f"jaxsfm: {named}{error.strerror or error}", file=sys.stderr)
        return 2
    except Exception as error:
        # XLA's allocator raises an exception type of its own, and Python one for the memory of a
        # thread. Any other exception is a fault in jaxsfm, and its traceback is shown.
        if not isinstance(error, MemoryError) and not any(each in str(error) for each in NO_MEMORY):
            raise
        print(
            "jaxsfm: out of memory. A smaller --max-size needs less memory; reconstruct also "
            "continues with a smaller --memory-gb, --images-at-once or --pairs-at-once",
            file=sys.stderr,
        )
        return 1


def _run(argv: list[str]) -> int:
    """Run one command, and write all that it has printed."""
    if argv == ["--version"]:
        print("\n".join(version_lines()))
        status = 0
    else:
        status = tyro.extras.subcommand_cli_from_dict(
            COMMANDS,
            prog="jaxsfm",
            description=DESCRIPTION,
            args=with_action(current(argv)),
            config=(tyro.conf.OmitArgPrefixes, tyro.conf.OmitSubcommandPrefixes),
        )
    if sys.stdout is not None:  # Python would report a failure at its end, with a traceback
        sys.stdout.flush()
    return status


if __name__ == "__main__":
    sys.exit(main())
