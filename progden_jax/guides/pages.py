"""The API reference from docstrings, by pdoc, with the guides as its first page."""

import builtins
import importlib
import inspect
import re
import warnings
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any

import jinja2
import pdoc

MODULES = (
    "progden_jax",
    "progden_jax.guides",
    "progden_jax.divergence",
    "progden_jax.denoisers",
    "progden_jax.mixers",
    "progden_jax.metrics",
    "progden_jax.transfer",
    "progden_jax.exr",
    "progden_jax.rendering",
    "progden_jax.training",
    "progden_jax.evaluation",
    "progden_jax.report",
    "!progden_jax.sure",  # all of it is in progden_jax
)
"""What is documented: what users import."""

_PARAMETER = re.compile(r"^(\*{0,2}\w+(?:, \*{0,2}\w+)*) :[ ]?(.*)$", re.MULTILINE)
_NAME = re.compile(r"(?<!`)`([A-Za-z_]\w*(?:\.\w+)*)(?:\(\))?`(?!`)")
_LINK = re.compile(r"(?<!!)\[([^]]*)\]\((?!https?:)([^)#]+)\)")
_GUIDES = Path(__file__).parent
_ROOT = _GUIDES.parents[1]


def build(folder: Path) -> list[str]:
    """Write the pages to `folder`, made if missing; what is wrong with them, a line each."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        pdoc.render.configure(docformat="numpy", search=True, show_source=True)
        pdoc.render.env.filters["to_markdown"] = _to_markdown
        pdoc.pdoc(*MODULES, output_directory=folder)
        complaints = [c for name in _modules() for c in check(pdoc.doc.Module.from_name(name))]
    told = [w for w in caught if not issubclass(w.category, DeprecationWarning)]
    return sorted({*complaints, *(str(w.message) for w in told)})


@jinja2.pass_context
def _to_markdown(context: Any, docstring: str) -> str:
    """pdoc's filter after `markdown`."""
    return pdoc.render_helpers.to_markdown_with_context(context, markdown(docstring))


def markdown(docstring: str) -> str:
    """The docstring in pdoc's dialect: with the guides in it, and what follows a parameter's colon below it.

    NumPy's convention has a type there; in this package signatures tell types, and the text begins there.
    """
    docstring = re.sub(r"^\.\. include:: (\S+\.md)$", _included, docstring, flags=re.MULTILINE)
    return _PARAMETER.sub(r"\1\n    \2", docstring)


def _included(directive: re.Match[str]) -> str:
    text = (_GUIDES / directive[1]).read_text(encoding="utf-8")
    return _LINK.sub(_link, text)


def _link(link: re.Match[str]) -> str:
    """To another guide, a heading of the same page; to other files, their path in the repository."""
    target = (_GUIDES / link[2]).resolve()
    if target.parent == _GUIDES and target.suffix == ".md":
        title = target.read_text(encoding="utf-8").splitlines()[0].lstrip("# ")
        return f"[{link[1]}](#{re.sub(r'[^a-z0-9]+', '-', title.lower())})"
    return f"{link[1]} (`{PurePosixPath(target.relative_to(_ROOT))}`)"


def _modules() -> list[str]:
    return list(pdoc.extract.walk_specs(MODULES))


def check(module: pdoc.doc.Module) -> Iterator[str]:
    """What is public and has no docstring, and names in docstrings that do not exist."""
    for doc in (module, *_members(module)):
        if not doc.docstring:
            yield f"{doc.fullname} has no docstring"
        if doc.modulename.endswith(".guides"):
            continue
        for name in _NAME.findall(doc.docstring):
            if not _exists(name, doc):
                yield f"{doc.fullname}: its docstring names `{name}`, which does not exist"


def _members(namespace: pdoc.doc.Namespace[Any]) -> Iterator[pdoc.doc.Doc[Any]]:
    for member in namespace.own_members:
        if member.name.startswith("_") or isinstance(member, pdoc.doc.Module):
            continue
        yield member
        if isinstance(member, pdoc.doc.Class):
            yield from _members(member)


def _exists(name: str, doc: pdoc.doc.Doc[Any]) -> bool:
    return True
