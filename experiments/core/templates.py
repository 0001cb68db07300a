"""What `python -m experiments new` writes: a reward, its test, and an experiment that tries it; `$name` is filled in.

All three pass the tests and run as they are, so that every step from there is a small one.
"""

REWARD = '''"""Share of the questions that were answered."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from touchr1_jax import masked
from touchr1_jax.types import Parsed, Target


def $name(parsed: Parsed, target: Target) -> Float[Array, ""]:
    """Mean over the asked attributes of 1 where the conclusion names a level, else 0."""
    answered = (parsed.conclude >= 0).astype(jnp.float32)
    return masked.mean(answered, target.asked)
'''

TEST = '''import pytest

from tests.touchr1_jax.rewards.examples import make_parsed, make_target
from touchr1_jax.rewards.$name import $name


@pytest.mark.parametrize(("conclude", "earned"), [((0, 2, 8), 1.0), ((0, -1, 8), 0.5), ((-1, -1, 8), 0.0)])
def test_hand_values(conclude, earned):
    """The first two attributes are asked; −1 is a conclusion that names no level."""
    assert $name(make_parsed(conclude), make_target(asked=(1, 1, 0))) == pytest.approx(earned)
'''

REWARD_EXPERIMENT = '''"""Does rewarding `$name` beside what the paper rewards change what a policy learns?

    make experiment EXP=$name [ARGS="--scale smoke"]

Arms of GRPO from one SFT checkpoint per seed and the same questions: the published reward, and the same with
`$name` added.

Cost: about 20 minutes on two cores with five seeds; `--scale smoke` under two.

Expected: to be written before the first run; a result that nobody foresaw is worth more where that can be shown.
"""

from experiments.study.ablation import Ablation, ablation_experiment
from experiments.study.scores import PUBLISHED

ABLATION = Ablation(
    arms={"published": PUBLISHED, "added": {**PUBLISHED, "$name": 0.1}},
    pairs=(("added", "published"),),
    curves=("reward", "reward_$name", "accuracy", "entropy", "parse_rate", "length"),
)

EXPERIMENT = ablation_experiment("$name", ABLATION)
'''

EXPERIMENT = '''"""Does more weight on the format reward change what a policy learns?

    make experiment EXP=$name [ARGS="--scale smoke"]

Arms of GRPO from one SFT checkpoint per seed and the same questions, which differ in the weights of
their rewards alone.

Cost: about 20 minutes on two cores with five seeds; `--scale smoke` under two.

Expected: to be written before the first run; a result that nobody foresaw is worth more where that can be shown.
"""

from experiments.study.ablation import Ablation, ablation_experiment
from experiments.study.scores import PUBLISHED

ABLATION = Ablation(
    arms={"published": PUBLISHED, "changed": {**PUBLISHED, "format": 0.3}},
    pairs=(("changed", "published"),),
)

EXPERIMENT = ablation_experiment("$name", ABLATION)
'''
