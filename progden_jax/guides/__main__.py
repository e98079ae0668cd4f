"""`python -m progden_jax.guides FOLDER`: the guides and the API reference as web pages, by pdoc.

Needs the extra `docs`: pip install 'progden_jax[docs]'. Exit status 1, and a line each, for what is public
and has no docstring, for names in docstrings that do not exist, and for whatever pdoc warns of.
"""

import argparse
import sys
from pathlib import Path


def main() -> int:
    """The exit status; pages are written also where there is something to complain of."""
    parser = argparse.ArgumentParser(
        prog="python -m progden_jax.guides",
        description="Write the guides and the API reference as web pages; open FOLDER/index.html.",
    )
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="made if missing")
    folder = parser.parse_args().folder
    try:
        from progden_jax.guides import pages
    except ModuleNotFoundError as error:
        print(f"{error.name} is missing: pip install 'progden_jax[docs]'", file=sys.stderr)
        return 1
    try:
        complaints = pages.build(folder)
    except OSError as error:
        complaints = [f"{error.filename}: {error.strerror}"]
    for complaint in complaints:
        print(complaint, file=sys.stderr)
    return 1 if complaints else 0


if __name__ == "__main__":
    sys.exit(main())
