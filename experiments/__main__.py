"""`python -m experiments`: run, continue, list, start and compare experiments, ask trained policies."""

import multiprocessing
import os
import re
import sys

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # see `experiments.core.numerics`; read when NumPy is imported
os.environ["MPLBACKEND"] = "svg"  # charts are files; by the name of a window that is gone matplotlib is not imported

from sensors_io.errors import require_kept, require_words
from sensors_io.signals import end_as_interrupted, leave_interrupted, say

SIGNALLED = 128
"""Exit statuses above it are those of a run that a signal stopped."""


def leave(status: int) -> None:
    """End the process; after a signal at once, without the interpreter's teardown.

    A signal may arrive while XLA compiles on a thread of its own.  The compilation would go on in a client that the
    interpreter frees at its end (a segmentation fault, or "free(): invalid pointer").  The run has closed its files.
    """
    if status > SIGNALLED:
        for child in multiprocessing.active_children():
            child.terminate()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    sys.exit(status)


def main() -> None:
    """Run the command line and end the process.

    A second or more goes by until all is imported, in which Ctrl-C is answered too.
    """
    end_as_interrupted()
    arguments = sys.argv[1:]
    try:
        from experiments.core.commands import ASKING, SWEEP, run_command
        from sensors_io.commands.console import print_in_any_encoding

        print_in_any_encoding()
        try:
            require_words(arguments)
            require_kept(arguments)
        except ValueError as error:
            say(f"ValueError: {error}")
            leave(2)
        if arguments and arguments[0] in ASKING:
            from experiments.ask.command import run_asking

            leave(run_asking(arguments))
        if arguments and arguments[0] == SWEEP:
            from experiments.core.sweep import main as sweep

            leave(sweep(arguments[1:]))
        status = run_command(arguments, "experiments")
        if status is None:
            from experiments.core.runner import run  # JAX and charts, which only runs need

            status = run(arguments)
    except KeyboardInterrupt as error:  # a run handles the signal itself
        status = leave_interrupted(error, "Stopped; nothing is half-written, and the same command can be run again.")
    except OSError as error:  # a folder that cannot be read or written, a full disk, a pipe that was closed
        say(f"{type(error).__name__}: {error}: correct the path, its permissions, or free some space")
        status = 1
    except ValueError as error:
        if "jax" in sys.modules or not re.search(r"\bJAX_|\bjax_", str(error)):
            raise
        # its import ended, which reads them
        say(f"ValueError: {error}: a variable of the environment that begins with JAX_; correct it, or unset it")
        status = 2
    leave(status)


if __name__ == "__main__":
    main()
