"""New experiments and rewards from templates that run as they are."""

import ast
import bisect
import keyword
import re
from collections.abc import Collection, Mapping
from pathlib import Path

import jinja2

from experiments.core.artifacts import write_text

DICTIONARY = Path("touchr1_jax/rewards/__init__.py")  # the file with an import and an entry for every reward

EXAMPLES = Path("tests/touchr1_jax/rewards/examples.py")  # answers and targets of the tests of rewards
_MAKER = "make_rewards"  # the function that returns the dictionary

_ANSWER = "<perceive> xense soft </perceive> <compare> soft </compare> <conclude> soft </conclude>"
"""An answer to try a reward on."""


class NewError(ValueError):
    """A new experiment or reward that cannot be made; nothing was written."""


def write_new(root: Path, name: str, *, reward: bool, taken: Collection[str]) -> tuple[list[Path], list[Path]]:
    """Write an experiment; with `reward` also a reward, its test, and its two lines in the dictionary.

    Everything is checked before the first file is written; if one cannot be written, the others are removed.  Returns
    the new files and the changed ones, relative to the top of the checkout; `NewError` says what is in the way.
    """
    if re.fullmatch("[a-z][a-z0-9_]*", name) is None or keyword.iskeyword(name):
        raise NewError(f"name is {name!r}: must be a lower-case Python name such as 'short_answers'; rename it")
    if name in taken:
        raise NewError(f"name is {name!r}: it is taken by an experiment, a command or a package; choose another")
    for path in (DICTIONARY, EXAMPLES):
        if not (root / path).exists():
            raise NewError(f"{root} holds no {path}: must be a checkout of the project; clone it and work there")
    loader = jinja2.FileSystemLoader(Path(__file__).parent / "templates")
    sources = jinja2.Environment(loader=loader, trim_blocks=True, keep_trailing_newline=True)
    templates, changed = {f"experiments/paper/{name}.py": "experiment"}, {}  # it begins as an ablation
    if reward:
        tested = f"tests/touchr1_jax/rewards/test_{name}.py"
        templates |= {f"touchr1_jax/rewards/{name}.py": "reward", tested: "reward_test"}
        changed[DICTIONARY] = with_entry((root / DICTIONARY).read_text(encoding="utf-8"), name)
    fill = lambda template: sources.get_template(f"{template}.py.jinja").render(name=name, reward=reward)
    made = {Path(path): fill(template) for path, template in templates.items()}
    for path in made:
        if (root / path).exists():
            raise NewError(f"{path} exists: nothing is overwritten; choose another name, or move the file away")
    _write(root, made | changed, new=made)
    return list(made), list(changed)


def _write(root: Path, texts: Mapping[Path, str], new: Collection[Path]) -> None:
    """New files come first, so that the dictionary never names a file that is not there."""
    try:
        for path, text in texts.items():
            write_text(root / path, text)
    except OSError:
        for path in new:
            (root / path).unlink(missing_ok=True)
        raise


def next_steps(name: str, *, reward: bool) -> list[str]:
    """The steps after `write_new`, one to a line."""
    steps = [
        f"edit touchr1_jax/rewards/{name}.py: the formula, in its docstring and below",
        f"edit tests/touchr1_jax/rewards/test_{name}.py: its hand values",
        f"python -m pytest tests/touchr1_jax/rewards/test_{name}.py",
        f'python -m touchr1_jax.rewards explain --weights {name} 1 --text "{_ANSWER}"',
        f"edit experiments/paper/{name}.py: its question, its arms, the result that you expect",
        f'make experiment EXP={name} ARGS="--scale smoke"',
        f"make experiment EXP={name}",
    ]
    return [f"  {step}" for step in (steps if reward else steps[4:])]


def with_entry(source: str, name: str) -> str:
    """The dictionary's source with the import and the entry of one more reward; `NewError` if it does not fit."""
    tree = ast.parse(source)
    imports = [node for node in tree.body if isinstance(node, ast.ImportFrom)]
    ours = [node for node in imports if str(node.module).startswith("touchr1_jax.rewards.")]
    makers = [node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == _MAKER]
    returned = [n.value for maker in makers for n in ast.walk(maker) if isinstance(n, ast.Return)]
    if not ours or len(returned) != 1 or not isinstance(returned[0], ast.Dict):
        raise NewError(
            f"{DICTIONARY}: {_MAKER} must return one dictionary after imports of rewards; add the lines by hand"
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
