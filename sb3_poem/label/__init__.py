"""The page on which a person answers, and what it needs: sessions, their store, videos, beliefs."""

from typing import Any

from sb3_poem.label.store import Store, StoreRecorder

__all__ = ["LabelWidget", "Store", "StoreRecorder"]


def __getattr__(name: str) -> Any:
    """The widget needs the extra ``[label]``; the store does not."""
    if name != "LabelWidget":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        from sb3_poem.label.widget import LabelWidget
    except ModuleNotFoundError as error:
        install = "pip install -c constraints.txt '.[label]' in a checkout"
        needs = f"LabelWidget needs the extra: {install}"
        raise ModuleNotFoundError(f"{needs} ({error})", name=error.name) from error
    return LabelWidget
