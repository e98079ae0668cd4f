"""The `progden` command: one module per subcommand, which import JAX only when they run."""

import os
import sys
from collections.abc import Sequence

from cyclopts import App, Parameter

from progden_jax import __version__
from progden_jax.cli import _run
from progden_jax.cli.demo import HELP as DEMO_HELP
from progden_jax.cli.demo import demo
from progden_jax.cli.denoise import HELP as DENOISE_HELP
from progden_jax.cli.denoise import denoise
from progden_jax.cli.devices import HELP as DEVICES_HELP
from progden_jax.cli.devices import devices
from progden_jax.cli.evaluate import HELP as EVALUATE_HELP
from progden_jax.cli.evaluate import evaluate
from progden_jax.cli.info import HELP as INFO_HELP
from progden_jax.cli.info import info
from progden_jax.cli.render import HELP as RENDER_HELP
from progden_jax.cli.render import render
from progden_jax.cli.report import HELP as REPORT_HELP
from progden_jax.cli.report import report
from progden_jax.cli.sweep import HELP as SWEEP_HELP
from progden_jax.cli.sweep import sweep
from progden_jax.cli.train import app as train

app = App(
    name="progden",
    version=__version__,
    help="Progressive denoising of Monte Carlo renders.\n\n```\nprogden denoise room.exr -o clean.exr\n```\n",
    help_format="markdown",
    help_epilogue="Exit status: 0 done, 1 failed, 2 wrong usage, 130 interrupted. "
    "With --debug anywhere, or PROGDEN_DEBUG=1, failures show a traceback.",
    default_parameter=Parameter(negative="", show_default=False),
    suppress_keyboard_interrupt=False,
)
_COMMANDS = {
    "denoise": (denoise, "IN... -o OUT [OPTIONS]", DENOISE_HELP),
    "evaluate": (evaluate, "[DATA...] -o OUTPUT [OPTIONS]", EVALUATE_HELP),
    "sweep": (sweep, "CONFIG -o OUTPUT [OPTIONS]", SWEEP_HELP),
    "info": (info, "IN... [OPTIONS]", INFO_HELP),
    "report": (report, "RUN -o SITE [OPTIONS]", REPORT_HELP),
    "demo": (demo, "[OPTIONS]", DEMO_HELP),
    "render": (render, "[SCENE...] -o OUT [OPTIONS]", RENDER_HELP),
    "devices": (devices, "[OPTIONS]", DEVICES_HELP),
}
for _name, (_command, _arguments, _help) in _COMMANDS.items():
    _usage = f"Usage: progden {_name} {_arguments}"
    app.command(_command, name=_name, help=_help, usage=_usage)
app.command(train)


def main(argv: Sequence[str] | None = None) -> int:
    """The exit status of `progden` with these arguments (by default the process's own)."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if "--debug" in arguments:
        os.environ["PROGDEN_DEBUG"] = "1"
        arguments = [a for a in arguments if a != "--debug"]
    command = arguments[0] if arguments and arguments[0] in (*_COMMANDS, "train") else ""

    def call() -> int | None:
        return app(arguments, exit_on_error=False, print_error=False, result_action="return_value")

    return _run.guarded(call, command)
