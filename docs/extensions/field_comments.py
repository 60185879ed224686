"""Fields are documented as the house does it: `m: float = 1.0  # mass [kg]`."""

import ast

from griffe import Docstring, Extension


class FieldComments(Extension):
    """Takes the comment behind a public field of a class for its docstring."""

    def on_attribute_instance(self, *, node, attr, **kwargs):
        if not isinstance(node, ast.AnnAssign) or attr.docstring or not attr.parent.is_class:
            return
        told = attr.parent.docstring.value if attr.parent.docstring else ""
        if "**Attributes:**" in told or "**Arguments:**" in told:
            return
        line = attr.lines_collection[attr.filepath][(node.end_lineno or node.lineno) - 1]
        comment = line[node.end_col_offset :].partition("#")[2].strip()
        if comment and not attr.name.startswith("_") and not comment.startswith(("pyright:", "type:")):
            attr.docstring = Docstring(comment[0].upper() + comment[1:] + ".", parent=attr)
