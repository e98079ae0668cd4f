"""Training of mixing networks, denoisers and combiners, see `progden train`.

Needs the extra ``train``: pip install 'progden_jax[train]'.
"""

from progden_jax.training.combiner_task import CombinerTask
from progden_jax.training.config import CombinerConfig, DenoiserConfig, MixerConfig, RunConfig
from progden_jax.training.denoiser_task import DenoiserTask
from progden_jax.training.loop import Outcome, Report, Trainer, train
from progden_jax.training.mixer_task import MixerTask
from progden_jax.training.step import State, Task

__all__ = [
    "CombinerConfig",
    "CombinerTask",
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
