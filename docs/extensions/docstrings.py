"""What docstrings leave to the code: units of fields, and signatures that are taken from a class."""

import ast
import re
from typing import Any

from griffe import Class, Docstring, Extension, Module, Parameters


class CodeComments(Extension):
    """Fields are documented as the house does it, `m: float = 1.0  # mass [kg]`: as a list below the class. A function
    with the arguments of a class has its signature."""

    def on_class_members(self, *, node: Any, cls: Class, **kwargs: Any) -> None:
        told = cls.docstring.value if cls.docstring else ""
        if not isinstance(node, ast.ClassDef) or "**Attributes:**" in told or "**Arguments:**" in told:
            return
        lines = cls.lines_collection[cls.filepath]
        rows = []
        for field in node.body:
            if not isinstance(field, ast.AnnAssign) or not isinstance(field.target, ast.Name):
                continue
            comment = lines[(field.end_lineno or 0) - 1][field.end_col_offset or 0 :].partition("#")[2].strip()
            if comment and not field.target.id.startswith("_"):
                value = f" = {ast.unparse(field.value)}" if field.value else ""
                rows.append(f"- `{field.target.id}{value}`: {comment}")
        if rows:
            tuples = any("NamedTuple" in ast.unparse(base) for base in node.bases)
            title = "**Components:**" if tuples else "**Parameters:**"
            cls.docstring = Docstring("\n\n".join([told, title, "\n".join(rows)]), parent=cls)

    def on_module_members(self, *, node: Any, mod: Module, **kwargs: Any) -> None:
        for function in mod.functions.values():
            for decorator in function.decorators:
                found = re.search(r"with_arguments_of\((\w+)", str(decorator.value))
                if found:
                    init = mod.classes[found[1]].functions["__init__"]
                    function.parameters = Parameters(*(p for p in init.parameters if p.name != "self"))
