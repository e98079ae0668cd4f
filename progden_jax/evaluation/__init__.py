"""Methods × renders → metrics, kept in one database per run; see `progden evaluate` and `progden sweep`.

YAML and Parquet need the extra ``evaluate``: pip install 'progden_jax[evaluate]'.
"""

from progden_jax.evaluation.database import Row, rows
from progden_jax.evaluation.exports import export
from progden_jax.evaluation.plan import Data, Method, Plan, load
from progden_jax.evaluation.run import Done, Report, carry_out
from progden_jax.evaluation.settings import Settings

__all__ = [
    "Data",
    "Done",
    "Method",
    "Plan",
    "Report",
    "Row",
    "Settings",
    "carry_out",
    "export",
    "load",
    "rows",
]
