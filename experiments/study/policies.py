"""The trained policies of a run, `policies/NAME/SEED`: published by studies, found again by name."""

import dataclasses
import os
import tempfile
from pathlib import Path
from typing import Any

from experiments.core import runs
from experiments.core.artifacts import fitting, jsonable, read_json
from experiments.core.context import Context
from experiments.core.text import bounds, number
from experiments.study.dataset import Dataset
from sensors_io.pipeline import ClipConfig
from sensors_io.remote import Mirror, at_url
from sensors_io.schema import Flag
from touchr1_jax.asking import HUB, AskablePolicy, load_policy, shipped
from touchr1_jax.bench.scoring import REPORTED
from touchr1_jax.models.adapted_folder import save_adapted
from touchr1_jax.models.lora import exported
from touchr1_jax.models.qwen.config import CONFIG_FILE
from touchr1_jax.models.released_policy import ReleasedPolicy
from touchr1_jax.models.saved_policy import (
    FORMAT,
    VERSION,
    PolicyError,
    PolicyInput,
    SavedPolicy,
    format_of,
    read_sealed,
    require_files,
    save_policy,
)
from touchr1_jax.models.touch_policy import TouchPolicy
from touchr1_jax.types import Params

FIGURES = ("acc", "h_acc", "r_acc", "p_acc", "mat_acc", "omae", "parse_rate")  # metrics of a model card
POLICIES = "policies"  # folder of a run with its trained policies
FILE = "file"  # note with the policy's place and its run, see `runs.labelled`
SCENES = "scenes"  # note with the configuration of the generated scenes that a policy was trained on

ONLY_SCENES = "generated scenes only: pictures of real sensors look different, and answers about them are guesses"
"""Note on the limits of a policy that was trained on generated scenes."""


def publish_policy(policy: TouchPolicy, params: Params, data: Dataset, name: str, seed: int, context: Context) -> None:
    """Save a policy in its run; of one on released weights the adapters, and where the weights are."""
    summary, meta = data.summary(), data.store.meta
    reads = PolicyInput(
        rejected=tuple(str(flag.name) for flag in data.clip.rejected),
        choose=data.clip.choose,
        show=data.clip.show,
        force=data.has_force,
        view=any(card.view is not None for card in data.store.objects.values()),
    )
    notes = {
        "name": f"{context.directory.parent.name}, {name}, seed {seed}",
        "trained on": f"{meta.source}: {summary['sft_objects']} objects by SFT, {summary['grpo_objects']} for GRPO",
        "records": data.store.digest,
        FILE: runs.labelled(context.directory, f"{POLICIES}/{name}/{seed}"),
        SCENES: meta.notes.get("config", {}),
    } | ({"limits": ONLY_SCENES} if meta.source == "generated" else {})
    saved = SavedPolicy(policy=policy, params=params, reads=reads, notes=jsonable(notes))
    folder = policy_folder(context, name, seed)
    if not isinstance(policy, ReleasedPolicy):
        merged = dataclasses.replace(saved, params=exported(params, policy.fns.lora))
        context.processes.write_once(lambda: save_policy(folder, merged))
        return
    weights = policy.checkpoint.directory.resolve()
    inside = weights.is_relative_to(context.directory.resolve())  # then the run can be moved as a whole
    place = os.path.relpath(weights, folder.resolve()) if inside else str(weights)
    context.processes.write_once(lambda: save_adapted(folder, saved, place))


def policy_folder(context: Context, name: str, seed: int) -> Path:
    """Where a run keeps a policy."""
    return context.directory / POLICIES / name / str(seed)


def find_policy(name: str, runs_dir: Path, weights: Path | None = None) -> AskablePolicy:
    """A policy by the folder of a run, RUN, RUN/ARM or RUN/ARM/SEED, or by what `load_policy` takes.

    Of a run the policy of SFT and the first seed is taken, since every study has it.  A policy may lie at a URL.
    `weights` as in `load_policy`; `PolicyError` or `StoreError` if there is none that can be read.
    """
    if at_url(name):
        with tempfile.TemporaryDirectory() as copied:
            Mirror(name).copy(Path(copied))
            return AskablePolicy(load_policy(copied, weights).saved, name)
    path = Path(name)
    folder = run_policy(name, runs_dir)
    if folder is not None:
        found = load_policy(folder, weights)
        require_own(folder, found.saved.notes.get(FILE))
        return found
    if not name or name.startswith(HUB) or path.exists() or name in shipped():
        return load_policy(name or None, weights)
    raise PolicyError(
        f"policy is {name!r}: must be a run, RUN/ARM or RUN/ARM/SEED under {runs_dir}, a policy's folder, "
        f"{HUB}USER/NAME, or one of {', '.join(shipped()) or 'those that come with the package (none)'}"
    )


def require_own(folder: Path, label: object) -> None:
    """`PolicyError` if a policy in the folder of a run is labelled as another; earlier versions have no label."""
    if label and label != (own := runs.labelled(folder.parents[2], "/".join(folder.parts[-3:]))):
        raise PolicyError(f"policy is {folder}: it is of {label}, must be of {own}; put its own copy back")


def require_published(folder: Path) -> None:
    """`PolicyError` if the folder of a run lacks its policy, or has a damaged or another one; no network is built."""
    config = read_sealed(folder, format_of(folder) or FORMAT, VERSION)
    require_files(folder, config["files"], config["files"])
    require_own(folder, config["notes"].get(FILE))


def fault_of(error: PolicyError) -> str:
    """Its message without the advice at the end, which is for policies that are not made again."""
    return str(error).rpartition(";")[0] or str(error)


def measured_figures(name: str, runs_dir: Path) -> dict[str, str]:
    """Scores of a run's policy on unseen objects, for its model card; empty for other policies and unfinished runs."""
    folder = run_policy(name, runs_dir)
    if folder is None or not runs.is_finished(run := folder.parents[2]):
        return {}
    with fitting(results := run / "results.json"):  # `config.json` of an earlier version may lack a field
        return _measured(runs.read_results(results, read_json(run / "config.json")), folder.parent.name)


def _measured(found: Any, arm: str) -> dict[str, str]:
    """Scores of an arm in the contents of `results.json`."""
    row = found.get("arms", {}).get(arm, {})
    figures = {}
    for metric in FIGURES:
        if metric in row:
            kind, (low, high) = REPORTED[metric], row[metric]["ci95"]
            shown = f"{number(row[metric]['mean'], kind.format)} {bounds(low, high, kind.format)} {kind.unit}"
            figures[f"{kind.title} ({kind.meaning})"] = shown.strip()
    seeds = max((len(one["per_seed"]) for one in row.values()), default=0)
    objects = found["data"].get("test_objects", "?")
    return {"measured": f"on {objects} unseen objects, {seeds} seeds, 95 % over objects"} | figures if figures else {}


def is_policy(name: str, runs_dir: Path) -> bool:
    """True if a name is that of a policy rather than of an input."""
    try:
        found = run_policy(name, runs_dir) is not None
    except PolicyError:
        return True
    return (
        found
        or name.startswith(HUB)
        or (at_url(name) and CONFIG_FILE in Mirror(name).files())  # records may lie at a URL too
        or name in shipped()
        or (Path(name) / CONFIG_FILE).is_file()
    )


def run_policy(name: str, runs_dir: Path) -> Path | None:
    """The folder of a policy of a run, which must have it; `None` where the name is that of no run."""
    parts = Path(name).parts
    for count in range(len(parts), max(len(parts) - 3, 0), -1):
        try:
            run = runs.locate(str(Path(*parts[:count])), runs_dir)
        except FileNotFoundError:
            continue
        described = read_json(run / "config.json")
        if not isinstance(described, dict) or "experiment" not in described:
            return None  # the config.json of a policy itself
        arm, seed = [*parts[count:], *["sft", "0"][len(parts) - count :]]
        folder = run / POLICIES / arm / seed
        if not folder.is_dir():
            saved = sorted(str(p.relative_to(run / POLICIES)) for p in (run / POLICIES).glob("*/[0-9]*/"))
            has = f"has {', '.join(saved)}" if saved else "has none: it trains none, or is of an earlier version"
            raise PolicyError(f"policy is {name!r}: {run} {has}; name RUN/ARM/SEED, or run the experiment again")
        return folder
    return None


def clip_of(saved: SavedPolicy) -> ClipConfig:
    """The clips that a policy reads; `PolicyError` if it leaves out frames by a flag that is unknown here."""
    unknown = sorted({*saved.reads.rejected} - {*Flag.__members__})
    if unknown:
        raise PolicyError(f"policy leaves out frames with the flags {', '.join(unknown)}: unknown; update touchr1-jax")
    return ClipConfig(
        frames=saved.model.frames,
        image_px=saved.model.image_px,
        view_px=saved.view_px,
        sensors=saved.sensors,
        rejected=tuple(Flag[name] for name in saved.reads.rejected),
        choose=saved.reads.choose,  # type: ignore[arg-type]
        show=saved.reads.show,  # type: ignore[arg-type]
    )
