"""One step of training: a pure function of the state, the examples and which of them to take."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import optax
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Float, Int

from progden_jax.training.config import RunConfig
from progden_jax.training.evaluation import Scores


class Task(Protocol):
    """What is trained. `arrays` are the examples, stacked along the first axis."""

    kind: str
    config: Any
    items: Any

    @property
    def arrays(self) -> Mapping[str, Any]:
        """Buffer name -> (N, ...)."""
        ...

    def init(self, key: jax.Array) -> Any:
        """Weights to start from."""
        ...

    def example(
        self, arrays: Mapping[str, Array], index: Array, key: jax.Array
    ) -> dict[str, Array]:
        """The example of that index, augmented by the key."""
        ...

    def loss(
        self, params: Any, batch: Mapping[str, Array]
    ) -> tuple[Float[Array, ""], dict[str, Array]]:
        """What to make small, a mean over the batch; and scalars for curves."""
        ...

    def evaluate(self, params: Any) -> Scores:
        """How these weights do on the held-out scenes."""
        ...

    def export(self, path: Any, params: Any, metadata: Mapping[str, str]) -> None:
        """Write these weights for use."""
        ...


class State(NamedTuple):
    """All that training goes on from; what a checkpoint holds.

    `average` are the averaged weights, `best` those of them with the lowest score so far, and `stale` how
    many evaluations have passed since.
    """

    step: Int[Array, ""]
    params: Any
    optimizer: Any
    average: Any
    best: Any
    best_score: Float[Array, ""]
    best_step: Int[Array, ""]
    stale: Int[Array, ""]


def schedule(config: RunConfig) -> optax.Schedule:
    """Learning rate per step: one cycle, up and down by cosines, or a constant per stage."""
    if config.rates:
        stages = [optax.constant_schedule(rate) for rate in config.rates]
        return optax.join_schedules(stages, list(config.rate_steps))
    return optax.cosine_onecycle_schedule(
        config.steps,
        config.peak_rate,
        config.warmup,
        config.start_divisor,
        config.end_divisor,
    )


def optimizer(config: RunConfig) -> optax.GradientTransformation:
    """Adam under the `schedule`, the gradient clipped first."""
    clip = [optax.clip_by_global_norm(config.clip_norm)] if config.clip_norm else []
    adam = optax.adamw(schedule(config), weight_decay=config.weight_decay)
    # All weights as one vector: fewer and larger operations.
    return optax.flatten(optax.chain(*clip, adam))


def make_start(task: Task) -> Callable[[Array], State]:
    """The compiled function from a key to the state at step 0."""

    def start(key: Array) -> State:
        params = task.init(key)
        zero = jnp.zeros((), jnp.int32)
        return State(
            step=zero,
            params=params,
            optimizer=optimizer(task.config).init(params),
            average=params,
            best=params,
            best_score=jnp.asarray(jnp.inf, jnp.float32),
            best_step=zero,
            stale=zero,
        )

    return jax.jit(start)


Step = Callable[[State, Mapping[str, Array], Array, Array], tuple[State, dict[str, Array]]]


def make_step(task: Task, mesh: Mesh | None = None) -> Step:
    """The compiled step: (state, arrays, key, indices) -> (state, scalars). The state given is used up.

    With a mesh of one axis "batch", each device takes a part of the batch; the rest is replicated.
    """
    config, transform = task.config, optimizer(task.config)

    def local(params: Any, arrays: Any, keys: Array, indices: Array) -> Any:
        batch = jax.vmap(task.example, (None, 0, 0))(arrays, indices, keys)
        return jax.value_and_grad(task.loss, has_aux=True)(params, batch)

    def shared(params: Any, arrays: Any, keys: Array, indices: Array) -> Any:
        return jax.lax.pmean(local(params, arrays, keys, indices), "batch")

    gradient = local
    if mesh is not None:
        split, whole = PartitionSpec("batch"), PartitionSpec()
        gradient = jax.shard_map(
            shared,
            mesh=mesh,
            in_specs=(whole, whole, split, split),
            out_specs=whole,
            check_vma=False,
        )

    def step(state: State, arrays: Any, key: Array, indices: Array) -> Any:
        keys = jax.random.split(jax.random.fold_in(key, state.step), len(indices))
        with jax.default_matmul_precision(config.precision):
            (loss, curves), found = gradient(state.params, arrays, keys, indices)
        updates, optimized = transform.update(found, state.optimizer, state.params)
        params = optax.apply_updates(state.params, updates)
        # The average's memory grows with the steps, so that it forgets the start.
        decay = jnp.minimum(config.ema, (1 + state.step) / (10 + state.step))
        average = optax.incremental_update(params, state.average, 1 - decay)
        scalars = {"loss": loss, "gradient": optax.tree.norm(found), **curves}
        changed = {
            "step": state.step + 1,
            "params": params,
            "optimizer": optimized,
            "average": average,
        }
        return state._replace(**changed), scalars

    return jax.jit(step, donate_argnums=0)


@jax.jit
def keep_best(state: State, score: Float[Array, ""]) -> State:
    """The state after an evaluation of its averaged weights gave this score."""
    better = score < state.best_score
    best = jax.tree.map(lambda a, b: jnp.where(better, a, b), state.average, state.best)
    return state._replace(
        best=best,
        best_score=jnp.where(better, score, state.best_score),
        best_step=jnp.where(better, state.step, state.best_step),
        stale=jnp.where(better, 0, state.stale + 1),
    )
