"""Notebooks run without Jupyter: what each code cell prints and shows."""

import ast
import base64
import contextlib
import io
import json
import re
from pathlib import Path
from typing import Any

from helpers.project import ROOT

QUICKSTART = ROOT / "examples" / "quickstart.ipynb"


def read(path: Path = QUICKSTART) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return found


def code_of(notebook: dict[str, Any]) -> list[dict[str, Any]]:
    return [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]


def outputs_of(source: str, names: dict[str, Any], count: int) -> list[dict[str, Any]]:
    """Run a cell like Jupyter, and return its outputs: printed text, and its last expression."""
    *body, last = ast.parse(source).body
    printed, shown = io.StringIO(), None
    with contextlib.redirect_stdout(printed):
        if not isinstance(last, ast.Expr):
            body.append(last)
        exec(compile(ast.Module(body, []), "notebook", "exec"), names)
        if isinstance(last, ast.Expr):
            shown = eval(compile(ast.Expression(last.value), "notebook", "eval"), names)
    found: list[dict[str, Any]] = []
    if text := printed.getvalue():
        found.append(
            {"name": "stdout", "output_type": "stream", "text": text.splitlines(keepends=True)}
        )
    if shown is not None:
        data: dict[str, Any] = {"text/plain": [re.sub(" at 0x[0-9A-Fa-f]+", "", repr(shown))]}
        if hasattr(shown, "_repr_png_") and (image := shown._repr_png_()):
            data["image/png"] = base64.b64encode(image).decode()
        elif hasattr(shown, "_repr_html_"):
            data["text/html"] = [shown._repr_html_()]
        found.append(
            {
                "data": data,
                "execution_count": count,
                "metadata": {},
                "output_type": "execute_result",
            }
        )
    return found


def text_of(outputs: list[dict[str, Any]]) -> list[str]:
    """Return the lines of text among outputs."""
    texts = ("".join(out.get("text") or out["data"]["text/plain"]) for out in outputs)
    return [line for text in texts for line in text.splitlines()]


def execute(
    notebook: dict[str, Any], names: dict[str, Any], folder: Path
) -> list[list[dict[str, Any]]]:
    """Run all code cells in order in a folder, and return the outputs of each."""
    sources = ["".join(cell["source"]) for cell in code_of(notebook)]
    with contextlib.chdir(folder):
        return [outputs_of(source, names, count) for count, source in enumerate(sources, 1)]


def written(notebook: dict[str, Any], outputs: list[list[dict[str, Any]]]) -> str:
    """Return the file of a notebook with other outputs."""
    for count, (cell, found) in enumerate(zip(code_of(notebook), outputs, strict=True), 1):
        cell |= {"execution_count": count, "outputs": found}
    return json.dumps(notebook, indent=1, sort_keys=True, ensure_ascii=False) + "\n"
