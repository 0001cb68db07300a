"""A run says how much memory it needs, and is refused where the process may not have it."""

import resource

import pytest

from experiments.ask.command import run_asking
from experiments.core import memory
from experiments.core.memory import free_bytes, require_memory
from touchr1_jax.distributed.processes import GIB, MachineError


@pytest.fixture
def limited():
    """A function that limits the address space of this process; nothing is allocated meanwhile."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    yield lambda size: resource.setrlimit(resource.RLIMIT_AS, (size, hard))
    resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def test_parts_and_what_is_free_are_named():
    line = require_memory({"clips at most": 3 * GIB // 2})
    assert line.startswith("memory: about 2.8 GiB (libraries and compiler 1.3, clips at most 1.5), ")
    assert "the system may end this run" in require_memory({"clips": free_bytes()})


def test_a_limit_that_would_abort_the_compiler_is_refused(limited):
    limited(64 * GIB)
    require_memory({"clips": GIB})
    limited(2 * GIB)
    with pytest.raises(MachineError, match=r"limited to 2 GiB: must be at least 3\.. GiB .*ulimit"):
        require_memory({"clips": GIB})


@pytest.mark.parametrize("words", [["ask", "generated"], ["demo", "--no-open", "--port", "0"]])
def test_a_policy_is_not_asked_where_its_compilation_would_abort(words, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(memory.resource, "getrlimit", lambda _: (2 * GIB, 2 * GIB))
    assert run_asking([*words, "--cache-dir", str(tmp_path)]) == 1
    assert capsys.readouterr().err.startswith(
        "MachineError: the address space is limited to 2 GiB: must be at least 2."
    )
