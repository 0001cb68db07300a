"""Small JSON files that are whole or not there."""

import json
import os
import pathlib
from collections.abc import Mapping
from typing import Any


def write_json(path: pathlib.Path, tree: Mapping[str, Any]) -> None:
    """Replace a file by JSON in one step; its folder is made if need be, for what is written was measured."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.tmp")
    with temporary.open("w") as file:
        json.dump(tree, file, indent=1, allow_nan=False)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)
