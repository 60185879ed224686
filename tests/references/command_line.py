"""The command line as a function."""

import contextlib
import io

from nsjax import __main__ as command


def run(*argv):
    """Exit status, standard output and standard error."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            status = command.main(list(map(str, argv)))
        except SystemExit as stop:  # from argparse
            status = stop.code
    return status, out.getvalue(), err.getvalue()
