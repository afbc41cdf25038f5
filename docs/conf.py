"""The documentation site: `make docs` builds it."""

import inspect
import re
from pathlib import Path

import gymnasium as gym

import sb3_poem

TOP = Path(__file__).resolve().parents[1]

project = "sb3_poem"
author = "the sb3_poem contributors"
copyright = author
version = release = sb3_poem.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx-mathjax-offline",
]
exclude_patterns = ["_build", "environments/_*"]

html_theme = "furo"
html_title = "sb3_poem"
html_static_path = ["_static"]
html_css_files = ["site.css"]

autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"

myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3
# Tutorials run while the site is built; what they print and draw is what the page shows.
nb_execution_mode = "cache"
nb_execution_timeout = 300
nb_execution_raise_on_error = True
# Where they are not executed, no kernel says which language they are in.
suppress_warnings = ["myst-nb.lexer"]


def environment_pages(_app: object) -> None:
    """A page a family, made from the docstring of its environment's class."""
    folder = TOP / "docs/environments"
    specs = [spec for spec in gym.registry.values() if spec.namespace == "poem"]
    link = {spec.name: f"[{spec.name}]({spec.name}.md)" for spec in specs}
    for spec in specs:
        cls = gym.envs.registration.load_env_creator(spec.entry_point)
        text = re.sub(r":\w+:`~?[\w.]*?\.?(\w+)`", r"`\1`", inspect.getdoc(cls) or "")
        text = re.sub(r"`(\w+)Env`", lambda found: link.get(found[1], found[0]), text)
        picture = f"../_static/environments/{spec.name}.webp"
        shown = f"![{spec.name}]({picture})\n\n" if (folder / picture).exists() else ""
        facts = f"`gymnasium.make({spec.id!r})`, {spec.max_episode_steps} steps an episode.\n"
        if (TOP / "pretrained" / spec.name).exists():
            card, results = f"../../pretrained/{spec.name}/README.md", "../results.md"
            facts += f"A trained model ships: [its card]({card}),\n"
            facts += f"[its results]({results}#{spec.name.lower()})."
        else:
            facts += f"Untrained: no model ships. `sb3-poem train --env {spec.id}` makes one.\n"
            facts += "[The results](../results.md) do not have it."
        page = folder / f"{spec.name}.md"
        content = f"# {spec.name}\n\n{facts}\n\n{shown}{text}\n"
        if not page.exists() or page.read_text() != content:
            page.write_text(content)


def files_beside_docs(_app: object, name: str, content: list[str]) -> None:
    """Markdown files outside of docs/ are downloads: MyST would look for them among the pages."""

    folder = TOP / "docs"

    def link(match: re.Match[str]) -> str:
        inside = ((folder / name).parent / match[1]).resolve().is_relative_to(folder)
        return match[0] if inside else f"](path:{match[1]})"

    content[0] = re.sub(r"\]\(((?:\.\./)+[^)#\s]+\.md)\)", link, content[0])


def setup(app: object) -> None:
    """Sphinx calls this."""
    app.connect("builder-inited", environment_pages)
    app.connect("source-read", files_beside_docs)
