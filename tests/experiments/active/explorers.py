"""A policy that chooses its touches with readers, none of them trained."""

import jax
import numpy as np

from experiments.active.contacts import ContactsConfig
from experiments.active.encoder import ContactEncoderConfig, ContactReader, SingleContact, patch_statistics
from experiments.active.saved import Explorer, touch_choices
from tests.touchr1_jax.drawn import draw_params
from tests.touchr1_jax.explored import DECODER
from touchr1_jax.models.active_policy import build_active_policy

CONTACTS = ContactsConfig(
    objects=2, motions=("press", "slide_x", "hold"), forces_n=(2.0,), sensors=("gelsight_mini",), picture_px=24
)
WIDTH = 8  # of a token: five properties, three levels


def frames(seed: int) -> np.ndarray:
    """Kept frames of a contact."""
    shape = (CONTACTS.moments, 36, 24, 3)
    return np.random.default_rng(seed).integers(0, 255, shape).astype(np.uint8)


def explorer(seed: int, budget: int = 2) -> Explorer:
    """An explorer whose parameters are drawn."""
    policy = build_active_policy(tuple(c.words for c in touch_choices(CONTACTS)), DECODER, repeats=False)
    params = draw_params(jax.eval_shape(lambda: policy.init(0, WIDTH)), seed, loud=0.3)
    encoder = ContactEncoderConfig(width=8, layers=1)
    statistics = np.stack([np.asarray(patch_statistics(frames(i)[None]))[0] for i in range(6)])
    choices = len(CONTACTS.choices)
    spread = np.broadcast_to(statistics.std(0), (choices, statistics.shape[1]))
    centre = np.broadcast_to(statistics.mean(0), spread.shape)
    module = SingleContact(encoder, choices)
    make = lambda key: module.init(jax.random.key(key), statistics, np.zeros(6, np.int32))["params"]
    readers = tuple(ContactReader(params=make(k), centre=centre, spread=spread) for k in range(2))
    return Explorer(
        policy=policy,
        params=params,
        contacts=CONTACTS,
        encoder=encoder,
        readers=readers,
        scale=0.5,
        budget=budget,
    )


def touching(budget: int = 2) -> tuple[Explorer, int]:
    """An explorer that touches for some question, and that question."""
    for seed in range(20):
        one = explorer(seed, budget)
        for question in range(5):
            if one.ask(question, lambda choice: None).choices:
                return one, question
    raise AssertionError("no drawn policy touches")
