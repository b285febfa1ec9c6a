"""HTML that is escaped by construction: text becomes markup only through `element`."""

from __future__ import annotations

from html import escape

_VOID = frozenset({"meta", "img", "br", "hr", "input", "link"})


class Html(str):
    """Markup that is safe to put into a page as it is."""

    __slots__ = ()


def element(tag: str, *children: str | None, **attributes: str | float) -> Html:
    """Return one element. Children that are not `Html` are escaped; None is left out.

    Args:
        tag: the element's name.
        children: what stands in it.
        attributes: by name; ``class_`` is ``class``, and other underscores become hyphens.
    """
    names = {"class_": "class", "viewBox": "viewBox"}
    given = "".join(
        f' {names.get(name, name.replace("_", "-"))}="{escape(str(value), quote=True)}"'
        for name, value in attributes.items()
    )
    if tag in _VOID:
        return Html(f"<{tag}{given}>")
    return Html(f"<{tag}{given}>{join_html(*children)}</{tag}>")


def join_html(*parts: str | None) -> Html:
    """Return the parts one after the other, escaped where they are not `Html`."""
    return Html("".join(part if isinstance(part, Html) else escape(part) for part in parts if part is not None))
