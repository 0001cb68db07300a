"""Operations and bytes of a step against counts by hand."""

import dataclasses

import pytest

from tests.touchr1_jax.distributed.sixteen import DECODER, GRPO, PROMPT
from touchr1_jax.distributed.memory import GRPOShape, head_weights, layer_weights
from touchr1_jax.distributed.mesh import MeshConfig
from touchr1_jax.distributed.work import Machine, Work, grpo_work, model_flops, phase_seconds, seconds
from touchr1_jax.models.qwen.config import released
from touchr1_jax.rl.config import Norm, Paper

ALONE = MeshConfig()
ONE = dataclasses.replace(DECODER, num_layers=1)


def shape(mesh=ALONE, **changes) -> GRPOShape:
    grpo = dataclasses.replace(GRPO, **changes)
    return GRPOShape(decoder=ONE, grpo=grpo, mesh=mesh, prompt_tokens=PROMPT.tokens)


def test_weights_by_hand():
    assert layer_weights(ONE) == 64 * 64 + 2 * 64 * 32 + 64 * 64 + 3 * 64 * 256
    assert head_weights(ONE) == 64 * 512
    seven = released("7B").decoder
    assert 28 * layer_weights(seven) + 2 * head_weights(seven) == pytest.approx(7.616e9, rel=1e-3)


def test_prompts_by_hand():
    """Sixteen prompts of 60 tokens: two operations a weight, and four a pair of tokens and channel of the heads."""
    tokens = PROMPT.tokens
    pairs = 16 * tokens * (tokens + 1) / 2
    flops = 2 * 16 * tokens * layer_weights(ONE) + 4 * pairs * 64 + 2 * 16 * head_weights(ONE)
    work = grpo_work(shape())["prompts"]
    assert work.flops == flops
    assert (work.gathered_bytes, work.summed_bytes) == (0, 0)
    assert work.read_bytes == 4 * (layer_weights(ONE) + head_weights(ONE))


def test_without_divergences_learning_is_three_passes():
    alone = shape(algorithm=Paper(beta=0.0, gamma=0.0))
    forward = grpo_work(alone)["prompts"].flops
    answers = 16 * 8 * 16
    forward += 2 * (answers * layer_weights(ONE) + (answers - 16) * head_weights(ONE))
    forward += 4 * 64 * answers * (PROMPT.tokens + 17 / 2)
    assert grpo_work(alone)["learning"].flops == pytest.approx(3 * forward)
    judged = grpo_work(shape(algorithm=Paper(gamma=0.0)))["learning"].flops
    both = grpo_work(shape(algorithm=Paper()))["learning"].flops
    assert (judged, both) == (pytest.approx(4 * forward), pytest.approx(7 * forward))
    followed = shape(algorithm=Paper(enumerated=Norm.NONE, learn_conclusion=False, beta=0.0, gamma=0.0))
    assert grpo_work(followed)["learning"].flops == judged, "conclusions that follow the reference need it"


@pytest.mark.parametrize("mesh", [MeshConfig(fsdp=8), MeshConfig(data=2, tensor=2), MeshConfig(fsdp=4, tensor=2)])
def test_devices_share_the_operations(mesh):
    assert model_flops(shape(mesh)) == pytest.approx(model_flops(shape()))


def test_what_prompts_gather_is_there_for_sampling():
    work = grpo_work(shape(MeshConfig(fsdp=8, tensor=2)))
    assert work["prompts"].gathered_bytes == 4 * (layer_weights(ONE) + head_weights(ONE)) / 2 * 7 / 8
    assert work["sampling"].gathered_bytes == 0


@pytest.mark.parametrize("field", ["flops", "far_bytes", "link_share"])
def test_a_machine_that_does_nothing_is_refused(field):
    with pytest.raises(ValueError, match=f"{field} is 0.0: must be above 0; raise it"):
        Machine(**{field: 0.0})


def test_a_phase_takes_its_longest_part_and_then_its_sums():
    machine = Machine(
        flops=10.0, read_bytes=5.0, near_bytes=4.0, far_bytes=1.0, flops_share=1.0, read_share=1.0, link_share=1.0
    )
    work = Work(flops=100.0, read_bytes=10.0, gathered_bytes=20.0, summed_bytes=8.0)
    assert phase_seconds(work, machine, MeshConfig(fsdp=4, tensor=2)) == 100 / 10 + 8 / 4
    assert phase_seconds(work, machine, MeshConfig(fsdp=8, tensor=2)) == 20 / 1 + 8 / 4  # weights from other machines
    there = shape(MeshConfig(fsdp=8, tensor=2))
    assert seconds(there, machine) == {n: phase_seconds(w, machine, there.mesh) for n, w in grpo_work(there).items()}
