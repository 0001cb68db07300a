"""Tunix's GRPO learner and sampler on the timed job (`job.py`), on the CPU, run by an interpreter that has Tunix.

    python3.11 -m venv TUNIX && TUNIX/bin/pip install google-tunix==0.1.7
    make experiment EXP=speed_grpo ARGS="--tunix-python TUNIX/bin/python"

Tunix needs a separate environment, because it pins other versions of JAX's companions than this project.  Functions
import Tunix, because the rest of the project does not need it.
"""

import time
from typing import Any

from experiments.engine.peers import BETA, CLIP, LEARNING_RATE, PAD_ID, PeerJob, format_answer, run_harness


class IdTokenizer:
    """Text is token ids between blanks."""

    def __init__(self, end_id: int) -> None:
        self._end_id = end_id

    def encode(self, text: str, **kwargs: Any) -> list[int]:
        return [int(word) for word in text.split()]

    def decode(self, ids: Any, **kwargs: Any) -> str:
        return " ".join(map(str, ids))

    def bos_id(self) -> None:
        return None

    def eos_id(self) -> int:
        return self._end_id

    def pad_id(self) -> int:
        return PAD_ID


def main(job: PeerJob) -> str:
    """Train for the iterations of the job, and return the line to print."""
    import jax
    import numpy as np
    import tunix
    from tunix.rl.grpo.grpo_learner import GRPOConfig, GRPOLearner

    starts: list[float] = []
    cluster = make_cluster(job)
    generate = cluster.generate

    def timed_generate(*args: Any, **kwargs: Any) -> Any:
        """An iteration runs from one sampling to the next; the sampler waits for the update's weights."""
        starts.append(time.perf_counter())
        return generate(*args, **kwargs)

    def reward(prompts: Any, completions: list[str], **kwargs: Any) -> list[float]:
        return [job.reward([int(word) for word in text.split()]) for text in completions]

    cluster.generate = timed_generate
    learner = GRPOLearner(
        rl_cluster=cluster,
        reward_fns=reward,
        algo_config=GRPOConfig(
            num_generations=job.size.group,
            num_iterations=1,
            beta=BETA,
            epsilon=CLIP,
            kl_loss_mode="low_var_kl",  # k3, as TRL and this project's default
        ),
    )
    texts = [[" ".join(map(str, ids)) for ids in batch] for batch in job.prompts()]
    learner.train([{"prompts": np.array(batch)} for batch in texts])
    return format_answer(job, starts, {"tunix": tunix.__version__, "jax": jax.__version__})


def make_cluster(job: PeerJob) -> Any:
    """Actor, reference and sampler of the job's size on one mesh of the CPU."""
    import jax
    import numpy as np
    import optax
    from tunix.rl import rl_cluster
    from tunix.rl.rollout.base_rollout import RolloutConfig

    mesh = jax.sharding.Mesh(np.array(jax.devices()[:1]).reshape(1, 1), ("fsdp", "tp"))
    role = rl_cluster.Role
    return rl_cluster.RLCluster(
        actor=make_policy(job),
        reference=make_policy(job),
        tokenizer=IdTokenizer(job.end_id),
        cluster_config=rl_cluster.ClusterConfig(
            role_to_mesh=dict.fromkeys((role.ACTOR, role.REFERENCE, role.ROLLOUT), mesh),
            rollout_engine="vanilla",
            offload_to_cpu=False,
            training_config=rl_cluster.RLTrainingConfig(
                actor_optimizer=optax.adamw(LEARNING_RATE),
                eval_every_n_steps=10**9,  # never
                max_steps=job.iterations,
                mini_batch_size=job.size.prompts,
                train_micro_batch_size=job.size.prompts,
            ),
            rollout_config=RolloutConfig(
                max_tokens_to_generate=job.size.length,
                max_prompt_length=job.prefix,
                kv_cache_size=job.prefix + job.size.length,
                temperature=1.0,
                top_p=1.0,
                top_k=None,
                eos_tokens=[job.end_id],
            ),
        ),
    )


def make_policy(job: PeerJob) -> Any:
    """A Qwen2 decoder with N(0, .02²) weights: some of Tunix's start at 0, for they are meant to be loaded."""
    import jax
    from flax import nnx
    from tunix.models.qwen2 import model as qwen2

    c = job.size
    config = qwen2.ModelConfig(
        num_layers=c.num_layers,
        vocab_size=c.vocab_size,
        embed_dim=c.hidden_size,
        hidden_dim=c.intermediate_size,
        num_heads=c.num_heads,
        head_dim=c.head_dim,
        num_kv_heads=c.num_kv_heads,
        norm_eps=1e-6,
        rope_theta=1_000_000,
        use_tied_embedding=True,
    )
    model = qwen2.Qwen2(config, rngs=nnx.Rngs(0))
    leaves, tree = jax.tree.flatten(nnx.state(model, nnx.Param))
    keys = jax.random.split(jax.random.key(0), len(leaves))
    drawn = [
        x if x.ndim == 1 else 0.02 * jax.random.normal(k, x.shape, x.dtype) for k, x in zip(keys, leaves, strict=True)
    ]
    nnx.update(model, jax.tree.unflatten(tree, drawn))
    return model


if __name__ == "__main__":
    run_harness(main)
