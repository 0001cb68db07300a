"""Collectives inside the loops of a compiled GRPO step: `python -m tests.touchr1_jax.distributed.exchanges`.

Writes as JSON the number of collective operations in the body of every loop, and in the whole program.
"""

import json
import re
import sys

from tests.touchr1_jax.distributed.problems import feed, grpo
from touchr1_jax.distributed.mesh import MeshConfig
from touchr1_jax.distributed.placement import shard_step

COLLECTIVE = re.compile(r" (?:all-gather|all-to-all|all-reduce|collective-permute|reduce-scatter)(?:-start)?\(")


def of_loops(program: str) -> dict[str, int]:
    """Body of a loop → collectives, from the text of a compiled program."""
    computations = {
        text.split()[0].lstrip("%"): text for text in re.split(r"\n(?=%|ENTRY)", program) if text.startswith("%")
    }
    bodies = set(re.findall(r"body=%?([\w.\-]+)", program))
    return {body: len(COLLECTIVE.findall(computations[body])) for body in bodies}


def main() -> None:
    """Compile for four devices along fsdp."""
    problem, mesh = grpo(), MeshConfig(fsdp=4).build()
    batch = next(feed(problem))
    step = shard_step(problem.step_on(mesh), mesh, problem.state, batch, *problem.shared)
    program = step.lower(problem.state, batch, *problem.shared).compile().as_text()
    sys.stdout.write(json.dumps({"loops": of_loops(program), "all": len(COLLECTIVE.findall(program))}))


if __name__ == "__main__":
    main()
