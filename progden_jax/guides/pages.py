"""The API reference from docstrings, by pdoc, with the guides as its first page."""

import builtins
import importlib
import re
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any

import jinja2
import markupsafe
import pdoc
from pdoc import doc as pdoc_doc
from pdoc import extract, render, render_helpers

import progden_jax

MODULES = (
    "progden_jax",  # and the modules that it exports
    "progden_jax.guides",
    "progden_jax.mixers",
    "progden_jax.adaptation",
    "progden_jax.exr",
    "progden_jax.rendering",
    "progden_jax.training",
    "progden_jax.evaluation",
    "progden_jax.report",
    "!progden_jax.sure",  # functions of the same names, shown one level up
    "!progden_jax.rendering.series",
)
"""What is documented: what users import."""

_CONVENTIONS = (
    "evaluate",
    "bind",
    "init",
    "setup",
    "tree_flatten",
    "tree_flatten_with_keys",
    "tree_unflatten",
)
"""Methods that a Protocol here, JAX of its pytrees or Flax of its modules documents once for all classes."""

_PARAMETER = re.compile(r"^(\*{0,2}\w+(?:, \*{0,2}\w+)*) :[ ]?(.*)$", re.MULTILINE)
_NAME = re.compile(r"(?<!`)`([A-Za-z_]\w*(?:\.\w+)*)(?:\(\))?`(?!`)")
_LINK = re.compile(r"(?<!!)\[([^]]*)\]\((?!https?:)([^)#]+)\)")
_DOT = r'</span><span class="o">\.</span>'
_PACKAGES = re.compile(rf'<span class="n">(?:jaxtyping|jax|jaxlib|_jax){_DOT}(?=<span class="n">)')
_GUIDES = Path(__file__).parent
_ROOT = _GUIDES.parents[1]


def build(folder: Path) -> list[str]:
    """Write the pages to `folder`, made if missing; what is wrong with them, a line each."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        render.configure(docformat="numpy", search=True, show_source=True)
        render.env.filters["to_markdown"] = _to_markdown
        render.env.filters["format_signature"] = _signature
        pdoc.pdoc(*MODULES, output_directory=folder)
        complaints = [c for name in _modules() for c in check(pdoc_doc.Module.from_name(name))]
    told = [w for w in caught if not issubclass(w.category, DeprecationWarning)]
    return sorted({*complaints, *(str(w.message) for w in told)})


@jinja2.pass_context
def _to_markdown(context: Any, docstring: str) -> str:
    """pdoc's filter after `markdown`."""
    return render_helpers.to_markdown_with_context(context, markdown(docstring))


def _signature(*arguments: Any, **options: Any) -> markupsafe.Markup:
    """pdoc's filter, with shapes as they are written: Float[Array, 'h w 3']."""
    text = render_helpers.format_signature(*arguments, **options)
    return markupsafe.Markup(_PACKAGES.sub("", text))


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
    return list(extract.walk_specs(MODULES))


def check(module: pdoc_doc.Module) -> Iterator[str]:
    """What is public and has no docstring, and names in docstrings that do not exist."""
    scope = {**vars(builtins), **vars(progden_jax), **vars(module.obj)}
    for doc, known in ((module, scope), *_members(module, scope)):
        if doc.name in _CONVENTIONS:
            continue
        if not doc.docstring and not isinstance(doc, pdoc_doc.Variable):
            yield f"{doc.fullname} has no docstring"
        for name in _NAME.findall(doc.docstring):
            if not _exists(name, known):
                yield f"{doc.fullname}: its docstring names `{name}`, which does not exist"


Scope = dict[str, Any]
"""What names stand for, None where that is not known: arguments, attributes, what the module has."""


def _members(namespace: pdoc_doc.Namespace[Any], scope: Scope) -> Iterator[tuple[Any, Scope]]:
    """What is documented within, each with the names that mean something there."""
    for member in namespace.own_members:
        source = member.taken_from[0]
        if member.name.startswith("_") or not source.startswith(progden_jax.__name__):
            continue
        if isinstance(member, pdoc_doc.Module):
            continue
        known = {**vars(sys.modules.get(source, builtins)), **scope}
        if isinstance(member, pdoc_doc.Function):
            known |= dict.fromkeys(member.signature.parameters)
        if isinstance(member, pdoc_doc.Class):
            known |= {name: getattr(m, "obj", None) for name, m in member.members.items()}
            if isinstance(made := member.members.get("__init__"), pdoc_doc.Function):
                known |= dict.fromkeys(made.signature.parameters)
            yield from _members(member, known)
        yield member, known


def _exists(name: str, scope: Scope) -> bool:
    first, *rest = name.split(".")
    if first != progden_jax.__name__:
        return first in scope and (scope[first] is None or _has(scope[first], rest))
    found: Any = progden_jax
    for count, part in enumerate(rest, 1):
        try:  # the module before the function of its name, which may hide it
            found = importlib.import_module(".".join((first, *rest[:count])))
        except ModuleNotFoundError:
            found = getattr(found, part, None)
    return found is not None


def _has(found: Any, names: list[str]) -> bool:
    for name in names:
        if not hasattr(found, name):
            return False
        found = getattr(found, name)
    return True
