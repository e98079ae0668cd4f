"""Training of mixing networks and denoisers, see `progden train`.

Needs the extra ``train``: pip install 'progden_jax[train]'.
"""

from progden_jax.training.config import DenoiserConfig, MixerConfig, RunConfig
from progden_jax.training.denoiser_task import DenoiserTask
from progden_jax.training.loop import Outcome, Report, Trainer, train
from progden_jax.training.mixer_task import MixerTask
from progden_jax.training.step import State, Task

__all__ = [
    "DenoiserConfig",
    "DenoiserTask",
    "MixerConfig",
    "MixerTask",
    "Outcome",
    "Report",
    "RunConfig",
    "State",
    "Task",
    "Trainer",
    "train",
]
