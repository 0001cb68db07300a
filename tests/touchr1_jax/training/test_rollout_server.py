"""Rollouts by a server: the same update as with the step's own, and every failure before anything is changed."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax.models.checkpoint import write_checkpoint
from tests.touchr1_jax.training.stand_in import (
    COMPLETE,
    LOAD,
    PATIENCE_S,
    UNLOAD,
    StandIn,
    changed,
    refusing,
    silent,
    truncated,
)
from touchr1_jax.models.load import load_checkpoint
from touchr1_jax.models.lora import LoraConfig, init_adapters
from touchr1_jax.models.policy import Features
from touchr1_jax.models.released_policy import ReleasedModel, build_released_policy
from touchr1_jax.models.stacked import ADAPTERS
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.models.touch_policy import with_lora
from touchr1_jax.rl.config import GRPOConfig, Paper
from touchr1_jax.rl.grpo import FrozenInputs, start_state
from touchr1_jax.rl.rollout import GRPOBatch
from touchr1_jax.rl.served import RolloutError
from touchr1_jax.training.loop import SingleDevice
from touchr1_jax.training.rollout_server import SEEDS, RolloutsConfig, RolloutServer
from touchr1_jax.training.train_grpo import grpo_program
from touchr1_jax.types import Parsed

pytestmark = pytest.mark.long

P, G, T = 2, 3, 5
SENSORS = ("gelsight_mini", "xense")
LORA = LoraConfig(rank=2, alpha=4.0, vision_targets=("qkv",))
ALGORITHM = Paper(beta=0.1, gamma=0.0, mismatch_limit=0.01)
CONFIG = GRPOConfig(prompts=P, group=G, length=T, micro_prompts=P, algorithm=ALGORITHM, lr_scale=1e4)
QUICK = {"tries": 2, "pause_s": 0.01}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    directory = tmp_path_factory.mktemp("released")
    write_checkpoint(directory)
    return directory


def policy_of(folder, dtype: str):
    model = ReleasedModel(
        tactile=TactileViTConfig(sensors=0, width=16, num_layers=0, num_heads=2, stem_width=4),
        frames=2,
        image_px=28,
        completion_tokens=64,
        view_px=16,
        dtype=dtype,
        in_order=True,
    )
    found = load_checkpoint(folder, jnp.dtype(dtype))
    return with_lora(build_released_policy(model, found, SENSORS), LORA)


@pytest.fixture(scope="module")
def policy(folder):
    return policy_of(folder, "float32")


def score(tokens, target):
    """Share of even tokens."""
    level = jnp.where(target.asked, tokens[0] % 3, -1)
    flag = jnp.array(False)
    length = jnp.int32(T)
    parsed = Parsed(jnp.tile(level, (len(SENSORS), 1)), level, level, flag, flag, length)
    reward = jnp.mean(tokens % 2)
    return reward, {"even": reward}, parsed


def batch_of(policy, seed: int = 0) -> GRPOBatch:
    """P made-up contacts; the second has one stream and no picture, so that its prompt is shorter."""
    rng, slots = np.random.default_rng(seed), policy.fns.slots
    width, dtype = policy.checkpoint.config.decoder.hidden_size, policy.fns.cache_dtype
    s, n = slots.touch.shape
    normal = lambda *shape: jnp.asarray(rng.normal(0, 0.5, shape), dtype)
    present = np.array([[True] * s, [True, *[False] * (s - 1)]])
    attribute = np.array([0, 3])
    return GRPOBatch(
        features=Features(
            touch=normal(P, s, n, width),
            touch_time=jnp.tile(jnp.arange(n, dtype=jnp.int32), (P, s, 1)),
            stream_mask=jnp.asarray(present),
            view=normal(P, len(slots.view), width),
            view_mask=jnp.array([True, False]),
        ),
        ids=jnp.asarray(policy.layout.ids[attribute]),
        mask=jnp.asarray(policy.layout.mask[attribute]),
        target=policy.target(attribute, np.zeros((P, 4), np.int32), present),
    )


class Training:
    """A step of GRPO on made-up contacts, with loud adapters."""

    def __init__(self, policy, config: GRPOConfig = CONFIG) -> None:
        self.policy, self.config = policy, config
        self.base = {"decoder": policy.checkpoint.params["decoder"]}
        lora = dataclasses.replace(LORA, vision_targets=())
        rng = np.random.default_rng(1)
        fresh = init_adapters(jax.random.key(0), self.base, lora)
        loud = jax.tree.map(lambda x: jnp.asarray(rng.normal(0, 0.3, x.shape), jnp.float32), fresh)
        self.optimizer, self.program = grpo_program(policy.fns, score, config, 10)
        self.trained = {ADAPTERS: loud}
        self.batch = batch_of(policy)
        noise = jnp.zeros_like(self.batch.features.touch[:1])
        self.frozen = FrozenInputs(reference=self.trained, noise=noise)

    def state(self):
        return start_state(self.trained, self.optimizer, jax.random.key(7), self.config)

    def step(self, state, batch):
        """By its own sampler, where the batch holds no rollouts."""
        return self.program(state, batch, self.frozen, self.base)

    def served(self, server: RolloutServer):
        """The same by rollouts of a server."""
        table = self.base["decoder"]["embedding"]["embedding"]
        return server.before(self.step, self.policy, table, self.config, SingleDevice())


def same_draws(stand_in: StandIn, state) -> None:
    """Give the server the random numbers of the step's own sampler."""
    key = jax.random.fold_in(state.key, state.step)
    seeds = jax.random.randint(jax.random.fold_in(key, SEEDS), (P,), 0, 2**31 - 1 - G)
    stand_in.draws = {int(seed): (jax.random.split(key)[0], P, i) for i, seed in enumerate(seeds)}


@pytest.fixture(scope="module")
def training(policy):
    return Training(policy)


@pytest.fixture(scope="module")
def running(policy):
    with StandIn(policy) as server:
        yield server


@pytest.fixture
def stand_in(running):
    """The server of the module, which knows nothing."""
    running.forget()
    return running


def server_of(stand_in: StandIn, tmp_path, **changes) -> RolloutServer:
    return RolloutServer(RolloutsConfig(url=stand_in.url, **changes), tmp_path / "adapters")


def test_the_update_is_that_of_the_steps_own_rollouts(training, stand_in, tmp_path):
    """Two steps, so that the server must have got the adapters of the first update."""
    served = training.served(server_of(stand_in, tmp_path))
    ours, theirs = training.state(), training.state()
    for _ in range(2):
        same_draws(stand_in, theirs)
        ours, own = training.step(ours, training.batch)
        theirs, other = served(theirs, training.batch)
        assert own["sampler_gap_peak"] < 1e-4
        assert other["sampler_gap_peak"] < 1e-4
        assert own["reward_std"] > 0
        for name in own.keys() - {"sampler_gap", "sampler_gap_peak"}:  # rounding alone, bounded above
            np.testing.assert_allclose(other[name], own[name], rtol=1e-4, atol=1e-5, err_msg=name)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=2e-5), ours.params, theirs.params)
    moved = jax.tree.map(lambda a, b: float(jnp.abs(a - b).max()), theirs.params, training.trained)
    assert max(jax.tree.leaves(moved)) > 1e-2
    paths = [path for path, _ in stand_in.requests]
    assert paths == 2 * [LOAD, *[COMPLETE] * P, UNLOAD]
    assert stand_in.served == {}
    assert list((tmp_path / "adapters").iterdir()) == []
    lengths = {len(body["prompt_embeds"]) for path, body in stand_in.requests if path == COMPLETE}
    assert len(lengths) == 2  # absent streams and pictures are not sent


def test_in_bfloat16_the_mismatch_is_small_and_not_zero(folder, tmp_path):
    policy = policy_of(folder, "bfloat16")
    training = Training(policy, dataclasses.replace(CONFIG, bfloat16=True))
    with StandIn(policy) as stand_in:
        _, metrics = training.served(server_of(stand_in, tmp_path))(training.state(), training.batch)
    assert 0 < metrics["sampler_gap_peak"] < 0.05
    assert 0 < metrics["sampler_gap"] < 0.01


def test_rollouts_of_other_weights_are_dropped_and_change_nothing(training, stand_in, tmp_path):
    """A server that forgets the adapters; the limit is far above what rounding makes."""
    stand_in.ignores_adapters = True
    state, metrics = training.served(server_of(stand_in, tmp_path))(training.state(), training.batch)
    assert metrics["dropped_share"] == 1
    assert metrics["sampler_gap"] > 0.1
    jax.tree.map(np.testing.assert_array_equal, state.params, training.trained)


def test_the_most_likely_tokens_reach_score_centering(policy, training, stand_in, tmp_path):
    """With the learner's own weights on the server the drift is zero, and so is what is subtracted."""
    algorithm = dataclasses.replace(ALGORITHM, score_centering=8)
    centred = Training(policy, dataclasses.replace(CONFIG, algorithm=algorithm))
    both = (t.served(server_of(stand_in, tmp_path))(t.state(), t.batch) for t in (training, centred))
    (a, own), (b, other) = both
    assert [body["logprobs"] for path, body in stand_in.requests if path == COMPLETE] == [1] * P + [8] * P
    np.testing.assert_allclose(other["grad_norm"], own["grad_norm"], rtol=1e-3)
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-4), a.params, b.params)


def drawing(training, stand_in, tmp_path, **changes):
    """(state, batch) → rollouts, as the step gets them."""
    step = lambda state, batch: (state, batch.rollout)
    table, server = training.base["decoder"]["embedding"]["embedding"], server_of(stand_in, tmp_path, **changes)
    return server.before(step, training.policy, table, CONFIG, SingleDevice())


@pytest.mark.parametrize(
    ("fault", "changes"),
    [(refusing(503), QUICK), (refusing(429), QUICK), (truncated, QUICK), (silent, {**QUICK, "timeout_s": PATIENCE_S})],
    ids=["503", "429", "truncated", "silence"],
)
def test_what_passes_is_tried_again(training, stand_in, tmp_path, fault, changes):
    _, expected = drawing(training, stand_in, tmp_path)(training.state(), training.batch)
    stand_in.faults = [fault]
    _, found = drawing(training, stand_in, tmp_path, **changes)(training.state(), training.batch)
    jax.tree.map(np.testing.assert_array_equal, found, expected)
    assert [path for path, _ in stand_in.requests].count(COMPLETE) == 2 * P + 1


@pytest.mark.parametrize(
    ("faults", "message"),
    [
        ([refusing(500)] * 9, r"gave no answer in 2 tries, the last ended in status 500 \(no room\); start the server"),
        ([refusing(400)], r"refuses with status 400 \(no room\); start it with --enable-prompt-embeds"),
        ([truncated] * 9, r"gave no answer in 2 tries, the last ended in IncompleteRead"),
        (
            [changed(lambda c: c.pop("token_ids"))],
            r"choices\[0\]\.token_ids of .* is None: must be a list of 1 to 5 ids",
        ),
        (
            [changed(lambda c: c.pop("logprobs"))],
            r"choices\[0\]\.logprobs\.token_logprobs of .* is None: must be a list",
        ),
        (
            [changed(lambda c: c["token_ids"].__setitem__(0, 512))],
            r"token_ids of .* is 512 at one place: must be one of 512",
        ),
        ([changed(lambda c: c["token_ids"].__setitem__(0, -1))], r"token_ids of .* is -1 at one place"),
        ([changed(lambda c: c["token_ids"].__setitem__(0, 1.5))], r"token_ids of .* is 1\.5 at one place"),
        (
            [changed(lambda c: c["logprobs"]["token_logprobs"].__setitem__(0, math.nan))],
            r"token_logprobs of .* is nan at one place: must be a finite log-probability",
        ),
        ([changed(lambda c: c["logprobs"]["token_logprobs"].__setitem__(0, None))], r"is None at one place"),
        ([changed(lambda c: c["logprobs"]["token_logprobs"].__setitem__(0, 0.5))], r"is 0\.5 at one place"),
        (
            [changed(lambda c: c["logprobs"]["token_logprobs"].pop())],
            r"token_logprobs of .*: must be a list of \d log-prob",
        ),
        (
            [changed(lambda c: c.update(index=7))],
            r"choices of .* is of 3 completions: must be of the group's 3, each with",
        ),
        ([changed(lambda c: c["token_ids"].insert(0, c["token_ids"][-1]))], r"token_ids of .* must be"),
    ],
)
def test_a_failure_is_named_before_anything_is_changed(training, stand_in, tmp_path, faults, message):
    stand_in.faults = list(faults)
    fails(training, drawing(training, stand_in, tmp_path, **QUICK), message)


def fails(training, drawn, message: str) -> None:
    """A step ends by one error, and its state is as before."""
    state = training.state()
    before = jax.tree.map(np.asarray, state.params)
    with pytest.raises(RolloutError, match=message):
        drawn(state, training.batch)
    jax.tree.map(np.testing.assert_array_equal, before, state.params)
    assert state.step == 0


def test_a_server_that_stays_silent_is_named(training, stand_in, tmp_path):
    drawn = drawing(training, stand_in, tmp_path, tries=1, timeout_s=PATIENCE_S)
    drawn(training.state(), training.batch)  # compiles what the server runs
    stand_in.faults = [silent] * P
    fails(training, drawn, "gave no answer in 1 tries, the last ended in TimeoutError")


def test_a_server_without_the_adapters_is_named(training, stand_in, tmp_path, monkeypatch):
    monkeypatch.setattr(stand_in, "served", Forgetful())
    message = r"refuses with status 404 \(.*The model `touch-\w+` does not exist"
    fails(training, drawing(training, stand_in, tmp_path, **QUICK), message)


class Forgetful(dict):
    """Adapters that are lost as soon as they are loaded."""

    def __setitem__(self, name, value):
        """Keep nothing."""


def test_a_server_that_is_down_is_named_before_anything_is_made(training, tmp_path):
    with StandIn(training.policy) as gone:
        url = gone.url
    server = RolloutServer(RolloutsConfig(url=url, **QUICK), tmp_path)
    with pytest.raises(RolloutError, match=rf"{url}/v1/models gave no answer in 2 tries, .*Connection refused"):
        training.served(server)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"temperature": 0.7}, r"temperature is 0\.7: must be 1\.0 where a server draws rollouts"),
        ({"top_p": 0.9}, r"top_p is 0\.9"),
        ({"algorithm": Paper(constrained=True)}, "constrained is True"),
        ({"algorithm": Paper(score_centering=4, updates=2)}, "updates is 2: must be 1 where score_centering is set"),
    ],
)
def test_settings_that_no_server_follows_are_named(training, stand_in, tmp_path, change, message):
    server, config = server_of(stand_in, tmp_path), dataclasses.replace(CONFIG, **change)
    with pytest.raises(ValueError, match=message):
        server.check(training.policy, config, SingleDevice())


def test_policies_and_devices_that_no_server_can_follow_are_named(folder, training, stand_in, tmp_path):
    server, policy = server_of(stand_in, tmp_path), training.policy
    check = lambda policy, devices: server.check(policy, CONFIG, devices)
    many = SingleDevice()
    many.shape = (1, 2, 1)
    with pytest.raises(ValueError, match=r"mesh is \(1, 2, 1\): must be one device"):
        check(policy, many)
    with pytest.raises(ValueError, match=r"lora\.targets is \(\): must name layers of the decoder"):
        check(with_lora(policy, dataclasses.replace(LORA, targets=())), SingleDevice())
    model = dataclasses.replace(policy.model, in_order=False)
    placed = with_lora(build_released_policy(model, policy.checkpoint, SENSORS), LORA)
    with pytest.raises(ValueError, match=r"model\.in_order is False: must be True"):
        check(placed, SingleDevice())


def test_a_url_without_a_protocol_is_named():
    with pytest.raises(ValueError, match=r"rollouts\.url is localhost:8000: must begin with http"):
        RolloutsConfig(url="localhost:8000")
