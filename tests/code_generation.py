"""Tests are compiled by XLA's older code generator for CPUs, without LLVM's optimisations, if there is one.

Compiling takes most of the suite's time, with these flags a third as much: the newer generator, which users
get, takes half as long again for most programs, and optimising loops over a few pixels never pays.
What XLA does before that is the same. What pins the compiler itself or outputs asks for `as_for_users`,
and commands that run as programs of their own for `users_environment`.
"""

import os
import subprocess
import sys

OURS = {
    "xla_cpu_use_fusion_emitters": "false",
    "xla_backend_optimization_level": "0",
    "xla_cpu_parallel_codegen_split_count": "1",
}
FLAGS = [f"--{option}={value}" for option, value in OURS.items()]
USERS: dict[str, bool | str] = {
    "xla_cpu_use_fusion_emitters": True,
    "xla_backend_optimization_level": "3",
}


def choose() -> None:
    """Put the flags into XLA_FLAGS, which workers and other processes inherit, unless one is there already.

    XLA ends the process over a flag that it does not know, so another process tries them.
    """
    given = os.environ.get("XLA_FLAGS", "")
    if any(option in given for option in OURS):
        return
    flags = " ".join([given, *FLAGS]).strip()
    attempt = subprocess.run(
        [sys.executable, "-c", "from jaxlib import xla_client; xla_client.CompileOptions()"],
        env=os.environ | {"XLA_FLAGS": flags},
        capture_output=True,
        check=False,
    )
    if attempt.returncode == 0:
        os.environ["XLA_FLAGS"] = flags


def users_environment() -> dict[str, str]:
    """The environment without the flags."""
    given = os.environ.get("XLA_FLAGS", "").split()
    return os.environ | {"XLA_FLAGS": " ".join(flag for flag in given if flag not in FLAGS)}


def as_for_users() -> dict[str, bool | str]:
    """For `jax.jit`'s `compiler_options`: the code that users get."""
    return USERS if set(FLAGS) <= set(os.environ.get("XLA_FLAGS", "").split()) else {}
