"""The command line: verbs that are declared with their options, see `cli/shared_options.py`.

Nothing is imported at the top: Ctrl-C during the imports, which take a second, ends in `main`.
"""

import sys
from collections.abc import Sequence


def main(argv: Sequence[str] | None = None) -> int:
    """Run the verb of a command line; return its exit code, see `EXIT_CODES` in core.errors."""
    try:
        from halbach_fe.cli import process, verbs

        return process.guarded(lambda: verbs.run(sys.argv[1:] if argv is None else argv))
    except KeyboardInterrupt:
        if sys.stderr is not None:
            sys.stderr.write("interrupted\n")
        return 130
