"""The command line: arguments -> a command -> exit code.

What a command takes and does is in ``commands``; nothing is loaded here that takes time, so that
whatever ends the program early finds its way to one line and the right status.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from usdbrdf.errors import UsdBrdfError
from usdbrdf.job.interrupts import Terminated, interruptible, loading
from usdbrdf.job.progress import (
    fill_closed_streams,
    in_one_line,
    keep_usd_off_stdout,
    set_quiet,
    show,
    tell,
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code, and raises nothing for a user's mistake."""
    try:
        with interruptible():
            fill_closed_streams()
            keep_usd_off_stdout()
            return _run(sys.argv[1:] if arguments is None else arguments)
    except UsdBrdfError as error:
        return _refuse(str(error), error.exit_code)
    except MemoryError:
        return _refuse(
            "out of memory. Free some, or ask for less: a larger --texel-size, or a smaller "
            "--width of pictures. [environment.memory]",
            4,
        )
    except KeyboardInterrupt:
        return _refuse("interrupted; the same command goes on from here.", 130)
    except Terminated:
        return _refuse("terminated; the same command goes on from here.", 143)
    except Exception as error:
        with loading():
            from usdbrdf.files.atomic import failure_of_machine
        if (failure := failure_of_machine(error)) is not None:
            return _refuse(str(failure), failure.exit_code)
        import traceback

        tell("".join(traceback.format_exception(error)).rstrip())
        return _refuse("this is a defect of usdbrdf; please report it with the lines above.", 1)


def _run(arguments: Sequence[str]) -> int:
    with loading():
        from usdbrdf.command_parser import help_text, parsed
        from usdbrdf.commands import COMMANDS
    if (page := help_text(arguments, COMMANDS)) is not None:
        show(page)
        return 0
    if arguments[:1] == ["--version"]:
        from usdbrdf.job.stamp import code_version

        show(f"usdbrdf {code_version()}")
        return 0
    with loading():
        from usdbrdf.files.paths import refuse_lost_folder
        from usdbrdf.job.compiler import refuse_unusable_settings
        from usdbrdf.job.memory import refuse_few_addresses
        from usdbrdf.job.processes import refuse_few_threads
    refuse_lost_folder()
    command = parsed(arguments, COMMANDS)
    set_quiet(getattr(command, "quiet", False))
    refuse_few_addresses()
    refuse_few_threads()
    refuse_unusable_settings()
    return command.run()


def _refuse(message: str, status: int) -> int:
    tell(f"usdbrdf: {in_one_line(message)}")
    return status
