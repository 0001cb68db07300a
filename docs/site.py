"""Pages of the site for mkdocs: the documents where they lie, notebooks, the API, a gallery of recorded results."""

import ast
import json
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

from experiments.core.commands import find
from experiments.core.recorded import recorded_names, show_recorded

ROOT = Path(__file__).resolve().parent.parent
BUILD = ROOT / "build"
PACKAGES = ("touchr1_jax", "sensors_io")
LINK = re.compile(r"\]\(([^)\s#]+)")


def on_config(config: Any) -> Any:
    """Add the API to the menu."""
    config.nav.append({"API": [{name: f"api/{name}.md"} for name in api_pages()]})
    return config


def on_files(files: Files, config: Any) -> Files:
    """Replace what lies in docs/ by the documents of the repository, under their own paths, and what they link."""
    for file in [file for file in files if file.src_dir == config.docs_dir]:
        files.remove(file)
    given = {f"api/{name}.md": text for name, text in api_pages().items()}
    given |= {path.with_suffix(".md").relative_to(ROOT).as_posix(): notebook_page(path) for path in notebooks()}
    given |= gallery(files, config)
    for uri, text in given.items():
        files.append(File.generated(config, uri, content=text))
    known, new = set(given), [ROOT / "README.md", *(ROOT / "docs").rglob("*.md"), *(ROOT / ".github").glob("*.md")]
    while new:
        path = new.pop()
        uri = path.relative_to(ROOT).as_posix()
        if uri in known or not path.is_file():
            continue
        known.add(uri)
        files.append(File.generated(config, uri, abs_src_path=str(path)))
        if path.suffix == ".md":
            links = LINK.findall(path.read_text(encoding="utf-8"))
            new += [(path.parent / link).resolve() for link in links if "://" not in link]
    return files


def api_pages() -> dict[str, str]:
    """Folder of modules, as in `touchr1_jax.rl` → a page that documents each of its modules."""
    pages: dict[str, str] = {}
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            if path.name == "__init__.py" or path.name == "__main__.py":
                continue
            module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
            folder = module.rpartition(".")[0]
            pages.setdefault(folder, f"# {folder}\n")
            pages[folder] += f"\n::: {module}\n"
    return pages


def notebooks() -> list[Path]:
    """Notebooks of the documents."""
    return sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))


def notebook_page(path: Path) -> str:
    """A notebook without outputs as a page."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    text = ["".join(cell["source"]) for cell in cells]
    shown = [f"```python\n{t}\n```" if c["cell_type"] == "code" else t for c, t in zip(cells, text, strict=True)]
    return "\n\n".join(shown) + "\n"


def gallery(files: Files, config: Any) -> dict[str, str]:
    """The page of recorded results with their charts; each report becomes a file of the site."""
    known, page = find("experiments"), "# Gallery\n\nRecorded results, each with its charts and its whole report.\n"
    for name in recorded_names():
        module = known[name].module
        show_recorded(name, module, BUILD / "recorded")
        source = ROOT / Path(*module.split(".")).with_suffix(".py")
        about = ast.get_docstring(ast.parse(source.read_text(encoding="utf-8"))) or name
        page += f"\n## {name}\n\n{about.partition(chr(10))[0]} [Report](reports/{name}/report.html)\n"
        folder = BUILD / "recorded" / name / "recorded"
        for path in [folder / "report.html", *sorted((folder / "plots").glob("*"))]:
            uri = f"reports/{name}/{path.relative_to(folder).as_posix()}"
            files.append(File.generated(config, uri, abs_src_path=str(path)))
            page += "" if path.suffix == ".html" else f"\n![{path.stem} of {name}]({uri})\n"
    return {"gallery.md": page}
