"""The page on which a person answers, and what it needs: sessions, their store, videos, beliefs."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sb3_poem.label.recording import StoreRecorder
    from sb3_poem.label.store import Store
    from sb3_poem.label.widget import LabelWidget

_HOME = {
    "LabelWidget": "sb3_poem.label.widget",
    "Store": "sb3_poem.label.store",
    "StoreRecorder": "sb3_poem.label.recording",
}

__all__ = ["LabelWidget", "Store", "StoreRecorder"]


def __getattr__(name: str) -> Any:
    """The store can be read without the extra ``[label]``, which the page needs."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOME[name]), name)
