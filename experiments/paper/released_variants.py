"""Further ways to ask a policy on released weights: before any training, and from the folder that it is written to."""

from pathlib import Path

from experiments.core.progress import in_megabytes
from experiments.paper.released_written import read_policy, write_policy
from experiments.study.answers import Evaluated, evaluate_policy
from experiments.study.stages import encode_contacts, untrained
from experiments.study.study import Trained


def zero_shot(trained: Trained) -> Evaluated:
    """The released model before any training: it sees the object's picture, and no touch, which it never learned to
    read; the system's text says what an answer looks like."""
    assembly, data = trained.assembly, trained.data
    params = untrained(assembly, data, trained.seed)
    test = encode_contacts(assembly, params, data, data.parts["test"], trained.context, blind=True)
    return evaluate_policy(assembly, params, test, trained.label, trained.context)


def folder_of(run: Path, seed: int) -> Path:
    """Where the policy of a seed is written."""
    return run / "weights" / str(seed)


def written(source: Path, trained: Trained) -> Evaluated:
    """The policy written to its folder, read from there, and asked again with all streams.

    Args:
      source: the released folder that it began from.
      trained: the policy.
    """
    assembly, data, context = trained.assembly, trained.data, trained.context
    folder = folder_of(context.directory, trained.seed)
    with context.progress_callback("writing weights, MB") as tell:
        context.processes.write_once(lambda: write_policy(folder, source, trained.params, in_megabytes(tell)))
    with context.progress_callback("reading weights, MB") as tell:
        params = read_policy(folder, assembly.fns.cache_dtype, in_megabytes(tell))
    test = encode_contacts(assembly, params, data, data.parts["test"], context)
    return evaluate_policy(assembly, params, test, trained.label, context, alone=False)
