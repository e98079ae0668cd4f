"""`python -m progden_jax` is `progden`."""

import sys

from progden_jax.cli import main

sys.exit(main())
