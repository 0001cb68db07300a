"""A server of vLLM's protocol for tests, which samples with the project's own decoder from received embeddings."""

import base64
import dataclasses
import http.server
import io
import json
import pickle
import threading
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import ml_dtypes
import numpy as np

from touchr1_jax.models.lora import LoraConfig
from touchr1_jax.models.qwen.peft import load_adapters
from touchr1_jax.models.released_policy import ReleasedPolicy
from touchr1_jax.models.stacked import ADAPTERS
from touchr1_jax.rl.rollout import SampleConfig, sample

PATIENCE_S = 5.0
"""Timeout of a client that meets `silent`: far above what an answer takes on a busy machine."""

LOAD, UNLOAD, COMPLETE = "/v1/load_lora_adapter", "/v1/unload_lora_adapter", "/v1/completions"


def read_torch(content: bytes) -> np.ndarray:
    """The tensor of a file of `torch.save`, by Python's own unpickler."""
    archive = zipfile.ZipFile(io.BytesIO(content))
    assert archive.read("archive/version") == b"3\n"
    assert archive.read("archive/byteorder") == b"little"

    class Reader(pickle.Unpickler):
        def find_class(self, module, name):
            return {
                "_rebuild_tensor_v2": lambda stored, offset, size, stride, *_: (stored, offset, size, stride),
                "FloatStorage": np.float32,
                "BFloat16Storage": ml_dtypes.bfloat16,
                "OrderedDict": dict,
            }[name]

        def persistent_load(self, pid):
            kind, dtype, key, place, count = pid
            assert (kind, place) == ("storage", "cpu")
            numbers = np.frombuffer(archive.read(f"archive/data/{key}"), dtype)
            assert len(numbers) == count
            return numbers

    numbers, offset, size, stride = Reader(io.BytesIO(archive.read("archive/data.pkl"))).load()
    assert offset == 0
    x = numbers.reshape(size)
    assert tuple(step // x.itemsize for step in x.strides) == stride
    return x


class StandIn:
    """The server, at `url`; `faults` are met by the next requests for completions, one each.

    A fault changes the answer, or handles the request itself and returns `None`.  `draws` gives seeds the noise of a
    row of a batch: (key, rows, row).
    """

    def __init__(self, policy: ReleasedPolicy) -> None:
        self.policy, self.params = policy, {"decoder": policy.checkpoint.params["decoder"]}
        self.forget()
        self._lock, self._programs = threading.Lock(), dict[Any, Any]()
        outer = self

        class Handler(http.server.BaseHTTPRequestHandler):
            def log_message(self, *_):
                """Say nothing."""

            def do_GET(self):
                """The served models."""
                reply(self, 200, json.dumps({"object": "list", "data": [{"id": "base"}]}))

            def do_POST(self):
                """Load, unload, complete."""
                body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
                outer.answer(self, body)

        self._server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self._server.server_address[1]}"

    def forget(self) -> None:
        """Neither adapters nor requests nor faults."""
        self.served: dict[str, tuple[Any, LoraConfig]] = {}
        self.requests: list[tuple[str, Any]] = []
        self.faults: list[Callable[[http.server.BaseHTTPRequestHandler, Any], Any]] = []
        self.draws: dict[int, tuple[jax.Array, int, int]] = {}
        self.ignores_adapters = False

    def __enter__(self) -> "StandIn":
        threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
        return self

    def __exit__(self, *_) -> None:
        self._server.shutdown()
        self._server.server_close()

    def answer(self, handler: http.server.BaseHTTPRequestHandler, body: Any) -> None:
        """One request; completions one after the other, for they share the cores."""
        self.requests.append((handler.path, body))
        name = body.get("lora_name") or body["model"]
        if handler.path == LOAD and name in self.served:
            reply(handler, 400, f"The LoRA adapter '{name}' has already been loaded.")
        elif handler.path == LOAD:
            self.served[name] = load_adapters(Path(body["lora_path"]), self.policy.checkpoint.config)
            reply(handler, 200, f"Success: LoRA adapter '{name}' added successfully.")
        elif name not in self.served:
            reply(handler, 404, json.dumps({"error": {"message": f"The model `{name}` does not exist."}}))
        elif handler.path == UNLOAD:
            del self.served[name]
            reply(handler, 200, f"Success: LoRA adapter '{name}' removed successfully.")
        else:
            with self._lock:
                found = self.complete(body)
                fault = self.faults.pop(0) if self.faults else None
            found = found if fault is None else fault(handler, found)
            if found is not None:
                reply(handler, 200, json.dumps(found))

    def complete(self, body: dict[str, Any]) -> dict[str, Any]:
        """A group of completions of one embedded prompt."""
        fns, x = self.policy.fns, read_torch(base64.b64decode(body["prompt_embeds"], validate=True))
        assert body["ignore_eos"]
        assert body["stop_token_ids"] == list(fns.end_ids)
        assert (body["temperature"], body["top_p"], body["top_k"], body["min_p"]) == (1.0, 1.0, 0, 0.0)
        assert body["repetition_penalty"] == 1.0
        assert body["return_token_ids"]
        assert body["return_tokens_as_token_ids"]
        banned = {int(i) for i, bias in body["logit_bias"].items() if bias == -100.0}
        assert banned == set(np.flatnonzero(fns.banned))
        adapters, lora = self.served[body["model"]]
        key, rows, row = self.draws.get(body["seed"], (jax.random.key(body["seed"]), 1, 0))
        length = self.policy.layout.ids.shape[1]
        mask = np.arange(length) >= length - len(x)
        padded = np.concatenate([np.zeros((length - len(x), x.shape[1]), x.dtype), x])
        program = self.program(body["n"], body["max_tokens"], rows, max(1, body["logprobs"]), lora)
        trained = {} if self.ignores_adapters else {ADAPTERS: adapters}
        found = jax.device_get(program({**self.params, **trained}, padded, mask, key))
        choices = []
        for i, (tokens, log_prob, there, ids, best) in enumerate(zip(*(y[row] for y in found), strict=True)):
            n = int(there.sum())
            heads = [
                {f"token_id:{v}": float(q) for v, q in zip(ids[t], best[t], strict=True)}
                | {f"token_id:{tokens[t]}": float(log_prob[t])}
                for t in range(n)
            ]
            said = {"token_logprobs": [float(v) for v in log_prob[:n]], "top_logprobs": heads}
            ended = "stop" if tokens[n - 1] in fns.end_ids else "length"
            choice = {"index": i, "text": "", "token_ids": [int(v) for v in tokens[:n]], "logprobs": said}
            choices.append(choice | {"finish_reason": ended})
        return {"object": "text_completion", "model": body["model"], "choices": choices[::-1]}

    def program(self, group: int, length: int, rows: int, most: int, lora: LoraConfig):
        """(params, embedded prompt, mask, key) → tokens, log-probabilities, mask and head of `rows` equal prompts."""
        fns = dataclasses.replace(self.policy.fns, lora=lora)
        draw = SampleConfig(group=group, length=length, end_ids=fns.end_ids, pad_id=fns.pad_id)

        def run(params, x, mask, key):
            positions = jnp.broadcast_to(jnp.cumsum(mask) - 1, (3, len(mask)))
            prefill = lambda module, *prompt: module.decoder.prefill(*prompt)
            hidden, prefix = fns._apply(params, prefill, x, positions, mask)
            several = lambda y: jnp.broadcast_to(y, (rows, *y.shape))
            first = several(fns.logits(params, hidden))
            decode = lambda *step: fns.decode(params, *step)
            drawn = sample(decode, first, jax.tree.map(several, prefix), fns.empty_cache(length), key, draw)
            states = lambda module, tokens: module.completion_states(tokens, hidden, prefix)
            each = jax.vmap(lambda tokens: fns._apply(params, states, tokens))(drawn.tokens)
            best, ids = jax.lax.top_k(jax.nn.log_softmax(fns.logits(params, each)), most)
            return drawn.tokens, drawn.log_prob, drawn.mask, ids, best

        asked = (group, length, rows, most, lora.scale)
        return self._programs.setdefault(asked, jax.jit(run))


def reply(handler: http.server.BaseHTTPRequestHandler, status: int, text: str, *, missing: int = 0) -> None:
    """An answer; `missing` bytes of it are announced and not sent."""
    content = text.encode()
    handler.send_response(status)
    handler.send_header("Content-Length", str(len(content) + missing))
    handler.end_headers()
    handler.wfile.write(content)


def refusing(status: int) -> Callable[..., None]:
    """A fault: the request is refused."""
    return lambda handler, found: reply(handler, status, "no room")


def truncated(handler: http.server.BaseHTTPRequestHandler, found: Any) -> None:
    """A fault: the answer ends early."""
    reply(handler, 200, json.dumps(found)[:-20], missing=20)


def silent(handler: http.server.BaseHTTPRequestHandler, found: Any) -> None:
    """A fault: no answer for a while."""
    time.sleep(2 * PATIENCE_S)


def changed(change: Callable[[dict[str, Any]], None]) -> Callable[..., Any]:
    """A fault: the first completion is changed."""

    def fault(handler: http.server.BaseHTTPRequestHandler, found: Any) -> Any:
        change(found["choices"][-1])
        return found

    return fault
