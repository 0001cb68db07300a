"""Rollouts of GRPO from a server of vLLM's protocol, which samples with the current adapters.

    vllm serve DIR --enable-prompt-embeds --enable-lora --max-lora-rank 16 --logprobs-mode processed_logprobs
    (with VLLM_ALLOW_RUNTIME_LORA_UPDATING=True)

Each step writes the adapters of the decoder in PEFT's format, makes the server load them under a new name, requests a
group of completions of every embedded prompt, and makes the server unload the adapters.  The update is the program of
`rl.grpo`, which takes the rollouts as arrays.
"""

import concurrent.futures
import contextlib
import dataclasses
import functools
import http.client
import json
import shutil
import time
import urllib.error
import urllib.request
import uuid
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from touchr1_jax.models.lora import Adapters
from touchr1_jax.models.qwen.peft import save_adapters
from touchr1_jax.models.released_policy import ReleasedPolicy
from touchr1_jax.models.stacked import ADAPTERS
from touchr1_jax.rl.config import GRPOConfig
from touchr1_jax.rl.grpo import GRPOState
from touchr1_jax.rl.rollout import GRPOBatch
from touchr1_jax.rl.served import (
    RolloutError,
    check_served,
    completion_request,
    embedded_prompts,
    read_completions,
)
from touchr1_jax.training.loop import SingleDevice, Step
from touchr1_jax.types import Rollout
from touchr1_jax.validation import above, at_least

MODELS, LOAD, UNLOAD, COMPLETE = "/v1/models", "/v1/load_lora_adapter", "/v1/unload_lora_adapter", "/v1/completions"

TRANSIENT = (408, 425, 429)
"""Status codes below 500 after which a request is made again."""

REMEDIES = {
    MODELS: "correct rollouts.url",
    LOAD: "start it with --enable-lora, a --max-lora-rank of at least lora.rank and "
    "VLLM_ALLOW_RUNTIME_LORA_UPDATING=True, and set rollouts.adapters to a folder that it reads",
    UNLOAD: "start it with VLLM_ALLOW_RUNTIME_LORA_UPDATING=True",
    COMPLETE: "start it with --enable-prompt-embeds on the weights that are trained",
}
"""Cures of a refusal."""

SEEDS = 3
"""Folded into the key of a step for the seeds of its groups; smaller numbers are taken (see `rl.grpo`)."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RolloutsConfig:
    """The server that draws the rollouts of GRPO; without a URL the step draws them itself.

    Raises:
      ValueError: a URL of another protocol, or a size out of range.
    """

    url: str | None = None
    """Address of a vLLM server of the same weights, such as http://localhost:8000."""
    adapters: Path | None = None
    """Folder that the server can read, for the adapters of a step; by default one in the run."""
    timeout_s: float = 600.0
    """Longest silence of the server."""
    tries: int = 5
    """Tries of a request before it fails."""
    pause_s: float = 1.0
    """Pause after the first try; it doubles after each."""

    def __post_init__(self) -> None:
        at_least(self, 1, "tries")
        at_least(self, 0, "pause_s")
        above(self, 0, "timeout_s")
        if self.url is not None and not self.url.startswith(("http://", "https://")):
            raise ValueError(f"rollouts.url is {self.url}: must begin with http:// or https://; correct it")


class RolloutServer:
    """A server that draws rollouts of a policy on released weights; `folder` is where it finds adapters by default."""

    def __init__(self, config: RolloutsConfig, folder: Path) -> None:
        self._config, self._url = config, (config.url or "").rstrip("/")
        self._folder = (config.adapters or folder).absolute()
        self._opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))  # a server is near: by no proxy

    def check(self, policy: ReleasedPolicy, config: GRPOConfig, devices: SingleDevice) -> None:
        """Refuse, before any work, settings that a server does not support, and a server that does not answer.

        Args:
          policy: with its adapters.
          config: of the steps.
          devices: where they run.

        Raises:
          ValueError: a policy without adapters in the decoder, with positions that no server has or with DeepStack,
            several devices, or as `check_served`.
          RolloutError: no answer, or none of this protocol.
        """
        check_served(config)
        needs = "where a server draws rollouts"
        if not policy.fns.lora.rank or not policy.fns.lora.targets:
            raise ValueError(f"lora.targets is {policy.fns.lora.targets}: must name layers of the decoder {needs}")
        if not policy.fns.module.config.in_order:
            raise ValueError(f"model.in_order is False: must be True {needs}; set it")
        if policy.checkpoint.config.vision.levels:
            kind = policy.checkpoint.config.vision.model_type
            raise ValueError(f"weights are of {kind}: must be of qwen2_5_vl {needs}, which takes one embedding a token")
        if devices.shape != (1, 1, 1):
            raise ValueError(f"mesh is {devices.shape}: must be one device {needs}; leave it, or rollouts.url, out")
        answer = self._send(MODELS)
        if not isinstance(answer, dict) or not isinstance(answer.get("data"), list):
            shown = str(answer)[:100]
            raise RolloutError(f"{self._url}{MODELS} answers {shown}: must be a list of models; correct rollouts.url")

    def before(
        self, step: Step, policy: ReleasedPolicy, table: Float[Array, "V D"], config: GRPOConfig, devices: SingleDevice
    ) -> Step:
        """The step of GRPO with rollouts drawn by the server; if these fail, nothing has changed.

        Args:
          step: (state, batch) → (state, metrics), by adapters.
          table: embeddings of the policy's decoder.
          policy, config, devices: as in `check`, which is called.
        """
        self.check(policy, config, devices)

        def drawn(state: GRPOState, batch: GRPOBatch) -> tuple[Any, dict[str, Array]]:
            sampler = state.behind[0] if state.behind else state.params
            key = jax.random.fold_in(jax.random.fold_in(state.key, state.step), SEEDS)
            seeds = jax.random.randint(key, (len(batch.ids),), 0, 2**31 - 1 - config.group)
            adapters, numbers = jax.device_get((sampler[ADAPTERS], seeds))
            rollout = self.rollouts(policy, adapters, table, batch, config, numbers)
            return step(state, dataclasses.replace(batch, rollout=rollout))

        return drawn

    def rollouts(
        self,
        policy: ReleasedPolicy,
        adapters: Adapters,
        table: Float[Array, "V D"],
        batch: GRPOBatch,
        config: GRPOConfig,
        seeds: Int[np.ndarray, "P"],
    ) -> Rollout:
        """A group of completions of each prompt, [P, G, T], drawn by the decoder with these adapters.

        Args:
          adapters: nested as the parameters of the policy, on the host; those of the decoder are sent.
          batch: P prompts.
          seeds: of each prompt's group.
          policy, table, config: as in `before`.

        Raises:
          RolloutError: a server that is missing, refuses, or gives no valid answer in time.
        """
        x, exists = jax.device_get(embedded_prompts(table, batch, policy.fns.slots))
        with self._serving(policy, adapters) as name:
            requests = [
                completion_request(name, prompt[there], config, policy.fns, int(seed))
                for prompt, there, seed in zip(x, exists, seeds, strict=True)
            ]
            with concurrent.futures.ThreadPoolExecutor(len(requests)) as threads:
                answers = list(threads.map(functools.partial(self._send, COMPLETE), requests))
        groups = [read_completions(answer, config, policy.fns) for answer in answers]
        return jax.tree.map(lambda *rows: np.stack(rows), *groups)

    @contextlib.contextmanager
    def _serving(self, policy: ReleasedPolicy, adapters: Adapters) -> Iterator[str]:
        """Adapters on the server, under a name of their own: it keeps the prefixes of prompts by the adapters' name."""
        name = f"touch-{uuid.uuid4().hex[:12]}"
        folder, lora = self._folder / name, dataclasses.replace(policy.fns.lora, vision_targets=())
        folder.mkdir(parents=True)
        try:
            found, own = policy.checkpoint, {"decoder": adapters["decoder"]}
            save_adapters(folder, own, found.config, lora, str(found.directory.absolute()))
            self._send(LOAD, {"lora_name": name, "lora_path": str(folder)})
            yield name
            self._send(UNLOAD, {"lora_name": name})
        finally:
            shutil.rmtree(folder)

    def _send(self, path: str, body: Mapping[str, Any] | None = None) -> Any:
        """The JSON of an answer; what loads and unloads is answered in words, of which nothing is kept.

        Raises:
          RolloutError: a refusal, or `tries` tries without an answer.
        """
        data, headers = None if body is None else json.dumps(body).encode(), {"Content-Type": "application/json"}
        request = urllib.request.Request(self._url + path, data, headers)
        for attempt in range(self._config.tries):
            if attempt:
                time.sleep(self._config.pause_s * 2 ** (attempt - 1))
            try:
                with self._opener.open(request, timeout=self._config.timeout_s) as answer:
                    content = answer.read()
                return json.loads(content) if path in (MODELS, COMPLETE) else None
            except urllib.error.HTTPError as error:
                problem = f"status {error.code} ({_message(error)})"
                if path == LOAD and attempt and "already" in problem:
                    return None  # the first answer was lost
                if error.code < 500 and error.code not in TRANSIENT:
                    raise RolloutError(f"{self._url}{path} refuses with {problem}; {REMEDIES[path]}") from error
            except (OSError, http.client.HTTPException, ValueError) as error:
                problem = f"{type(error).__name__} ({error})"
        raise RolloutError(
            f"{self._url}{path} gave no answer in {self._config.tries} tries, the last ended in {problem}; start the "
            "server, correct rollouts.url, or raise rollouts.timeout-s"
        )


def _message(error: urllib.error.HTTPError) -> str:
    """Beginning of the text of a refusal."""
    try:
        return error.read(300).decode("utf-8", errors="replace").strip()
    except (OSError, http.client.HTTPException):
        return "without a text"
