"""Tests are compiled by XLA's older code generator for CPUs, where it is to be had.

Compiling takes most of the suite's time, and the newer one, which users get, takes half as long again for
most programs (not where random numbers are mapped over). Optimisations are the same. What pins the compiler
itself or outputs asks for `as_for_users`, and commands that run as programs of their own for
`users_environment`.
"""

import os
import subprocess
import sys

OPTION = "xla_cpu_use_fusion_emitters"
FLAG = f"--{OPTION}=false"


def choose() -> None:
    """Put the flag into XLA_FLAGS, which workers and other processes inherit, unless there is one already.

    XLA ends the process over a flag that it does not know, so another process tries it.
    """
    given = os.environ.get("XLA_FLAGS", "")
    if OPTION in given:
        return
    attempt = subprocess.run(
        [sys.executable, "-c", "from jaxlib import xla_client; xla_client.CompileOptions()"],
        env=os.environ | {"XLA_FLAGS": FLAG},
        capture_output=True,
        check=False,
    )
    if attempt.returncode == 0:
        os.environ["XLA_FLAGS"] = f"{given} {FLAG}".strip()


def users_environment() -> dict[str, str]:
    """The environment without the flag."""
    given = os.environ.get("XLA_FLAGS", "").split()
    return os.environ | {"XLA_FLAGS": " ".join(flag for flag in given if flag != FLAG)}


def as_for_users() -> dict[str, bool]:
    """For `jax.jit`'s `compiler_options`: the code that users get."""
    return {OPTION: True} if FLAG in os.environ.get("XLA_FLAGS", "").split() else {}
