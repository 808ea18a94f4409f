"""Types of signatures: linked where they are public, and text otherwise.

What a docstring names by a role (``:class:``, ``:meth:``) is no type of a signature: it
has to be found, else the build fails.
"""

from __future__ import annotations

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.util.nodes import make_refnode


def link(
    app: Sphinx, env: BuildEnvironment, node: pending_xref, text: nodes.Element
) -> nodes.Element | None:
    """Find the public name of a type that lives elsewhere in its package."""
    is_from_a_role = "refwarn" in node
    if node["refdomain"] != "py" or is_from_a_role:
        return None
    word = node["reftarget"].rpartition(".")[2]
    objects = env.domains.python_domain.objects
    matches = [(k, v) for k, v in objects.items() if k.rpartition(".")[2] == word]
    matches = [(k, v) for k, v in matches if v.objtype in ("class", "exception")]
    if len(matches) != 1 or not node["reftarget"].startswith(("mi_nerfattack.", word)):
        return text
    ((_, entry),) = matches
    return make_refnode(app.builder, node["refdoc"], entry.docname, entry.node_id, text)


def setup(app: Sphinx) -> dict[str, bool]:
    """Connect the search for types."""
    app.connect("missing-reference", link)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
