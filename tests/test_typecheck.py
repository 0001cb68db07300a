"""The tests check shapes where functions annotate them, and cost the other functions nothing."""

import jax.numpy as jnp
import pytest
from jaxtyping import TypeCheckError

from touchr1_jax import masked
from touchr1_jax.models.policy_fns import PolicyFns
from touchr1_jax.rl import losses
from touchr1_jax.text import lexer


def test_a_wrong_argument_is_refused():
    with pytest.raises(TypeCheckError, match=r"masked\.count"):
        masked.count(jnp.zeros(3), jnp.ones(3))  # the mask must be of booleans


def test_dimensions_of_arguments_must_agree():
    with pytest.raises(TypeCheckError, match=r"losses\.exact_kl"):
        losses.exact_kl(jnp.zeros((2, 3)), jnp.zeros((2, 4)))


def test_functions_without_shapes_are_left_alone():
    assert hasattr(PolicyFns.group_logits, "__wrapped__")
    assert not hasattr(lexer.phrases_of, "__wrapped__")
    assert not hasattr(lexer.Lexer.__init__, "__wrapped__")
