"""A run's results as a static page: pictures, convergence plots and tables, without any network.

`build_report` reads the folder that `progden evaluate` and `progden sweep` write. Nothing is drawn
here: the page (`site/`, plain HTML, CSS and JavaScript) draws in the browser from what is stored.
"""

from progden_jax.report.build import build_report

__all__ = ["build_report"]
