"""New experiments and rewards from templates that run as they are."""

import ast
import bisect
import keyword
import re
from collections.abc import Collection, Mapping
from pathlib import Path

import jinja2

from experiments.core.artifacts import write_text

DICTIONARY = Path("touchr1_jax/rewards/__init__.py")
"""The file with an import and an entry for every reward."""

EXAMPLES = Path("tests/touchr1_jax/rewards/examples.py")
"""Answers and targets of the tests of rewards."""

MAKER = "make_rewards"
"""The function that returns the dictionary."""

FAMILY = Path("experiments/paper")
"""The folder of a new experiment: it begins as an ablation, and lies with the others."""

SOURCES = jinja2.Environment(
    loader=jinja2.FileSystemLoader(Path(__file__).parent / "templates"), trim_blocks=True, keep_trailing_newline=True
)
"""Templates of source files."""

_NAME = re.compile(r"[a-z][a-z0-9_]*")


class NewError(ValueError):
    """A new experiment or reward that cannot be made; nothing was written."""


def write_new(root: Path, name: str, *, reward: bool, taken: Collection[str]) -> tuple[list[Path], list[Path]]:
    """Write an experiment; with `reward` also a reward, its test, and its two lines in the dictionary.

    Everything is checked before the first file is written; if one cannot be written, the others are removed.

    Args:
      root: top of a checkout.
      name: of the experiment and the reward.
      reward: whether it tries a new reward.
      taken: names that an experiment cannot have.

    Returns:
      the new files and the changed ones, relative to the checkout.

    Raises:
      NewError: a name that is no lower-case Python name or taken, a file that exists, or no checkout.
    """
    if _NAME.fullmatch(name) is None or keyword.iskeyword(name):
        raise NewError(f"name is {name!r}: must be a lower-case Python name such as 'short_answers'; rename it")
    if name in taken:
        raise NewError(f"name is {name!r}: it is taken by an experiment, a command or a package; choose another")
    fill = lambda template: SOURCES.get_template(f"{template}.py.jinja").render(name=name, reward=reward)
    texts = {FAMILY / f"{name}.py": fill("experiment")}
    changed: dict[Path, str] = {}
    for path in (DICTIONARY, EXAMPLES):
        if not (root / path).exists():
            raise NewError(f"{root} holds no {path}: must be a checkout of the project; clone it and work there")
    if reward:
        texts[Path(f"touchr1_jax/rewards/{name}.py")] = fill("reward")
        texts[Path(f"tests/touchr1_jax/rewards/test_{name}.py")] = fill("reward_test")
        changed[DICTIONARY] = with_entry((root / DICTIONARY).read_text(encoding="utf-8"), name)
    for path in texts:
        if (root / path).exists():
            raise NewError(f"{path} exists: nothing is overwritten; choose another name, or move the file away")
    _write(root, texts, changed)
    return list(texts), list(changed)


def with_entry(source: str, name: str) -> str:
    """The dictionary's source with the import and the entry of one more reward.

    Raises:
      NewError: a reward of that name is there, or the source has another form than expected.
    """
    tree = ast.parse(source)
    imports = [node for node in tree.body if isinstance(node, ast.ImportFrom) and node.module is not None]
    ours = [node for node in imports if str(node.module).startswith("touchr1_jax.rewards.")]
    makers = [node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == MAKER]
    returned = [n.value for maker in makers for n in ast.walk(maker) if isinstance(n, ast.Return)]
    if not ours or len(returned) != 1 or not isinstance(returned[0], ast.Dict):
        raise NewError(
            f"{DICTIONARY}: {MAKER} must return one dictionary after imports of rewards; add the lines by hand"
        )
    entries = returned[0]
    if name in {key.value for key in entries.keys if isinstance(key, ast.Constant)}:
        raise NewError(f"name is {name!r}: {DICTIONARY} has a reward of that name; choose another")
    lines = source.splitlines()
    lines.insert(entries.values[-1].end_lineno or 0, f'        "{name}": Reward({name}),')  # the lower line first
    module = f"touchr1_jax.rewards.{name}"
    place = bisect.bisect([str(node.module) for node in ours], module)
    line = ours[place].lineno - 1 if place < len(ours) else ours[-1].end_lineno or 0
    lines.insert(line, f"from {module} import {name}")
    return "\n".join(lines) + "\n"


def _write(root: Path, texts: Mapping[Path, str], changed: Mapping[Path, str]) -> None:
    """The new files first, so that the dictionary never names a file that is not there."""
    done: list[Path] = []
    try:
        for path, text in {**texts, **changed}.items():
            write_text(root / path, text)
            done.append(path)
    except OSError:
        for path in done:
            (root / path).unlink()
        raise
