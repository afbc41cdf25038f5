"""Makes the pictures of README, of the families' pages and of the page's choice of robots anew:
``python docs/pictures.py``.

They are films of the models that ship, so they change with them. Needs off-screen rendering, and
playwright with Chromium for those of the page itself.
"""

import io
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import gymnasium as gym
import imageio.v3 as iio
import numpy as np
from PIL import Image

import sb3_poem
from sb3_poem import cli
from sb3_poem.adaptation import AdaptedPolicy
from sb3_poem.common.rollouts import rollout_latents
from sb3_poem.label.families import find_models
from sb3_poem.label.rendering import WIDTH, renderer_of
from sb3_poem.label.server import ROBOTS
from sb3_poem.resources import shipped_folder

STATIC = Path(__file__).with_name("_static")
#: Of a loop on the page's choice of robots: what moves for longer than five seconds needs a button
LOOP_PICTURES, LOOP_MILLISECONDS = 14, 170


def before_and_after(model: str, path: Path, task: str, width: int = 640, every: int = 3) -> None:
    """A robot before and after ten answers, side by side, as an animated WebP."""
    with tempfile.TemporaryDirectory() as folder:
        film = Path(folder, "film.mp4")
        cli.main(["record-video", "--model", model, "--task", *task.split(), "--out", str(film)])
        frames = iio.imread(film)[::every]
    height = round(width * frames.shape[1] / frames.shape[2])
    images = [Image.fromarray(frame).resize((width, height)) for frame in frames]
    first, *others = images
    first.save(path, save_all=True, append_images=others, duration=50 * every, loop=0, quality=60)


def still(env_id: str, path: Path, size: int = 360, steps: int = 50) -> None:
    """A family's robot at work: adapted if a model ships, moving at random otherwise."""
    env = gym.make(env_id, render_mode="rgb_array", width=size, height=size)
    obs, _ = env.reset(seed=2)
    env.action_space.seed(2)
    act = adapted(env) if (shipped_folder("pretrained") / env.spec.name).exists() else None
    obs, _ = env.reset()
    for _ in range(min(steps, env.spec.max_episode_steps - 1)):
        obs, *_ = env.step(env.action_space.sample() if act is None else act.predict(obs)[0])
    Image.fromarray(env.render()).save(path, quality=80)
    env.close()


def both(model: str, folder: Path) -> None:
    """How two training tasks' policies go and where they end, in one scene, for the choice of
    robots: a loop that plays twice in under five seconds, and its last picture for whoever wants no
    motion.
    """
    info = find_models(model)[0]
    renderer, means = renderer_of(info), renderer_of(info).model.train_tasks.latent_means
    distances = np.linalg.norm(means[:, None] - means, axis=2)
    pair = np.unravel_index(distances.argmax(), distances.shape)
    latents, seeds = means[list(pair)], [2, 2]
    clips = rollout_latents(renderer.model, renderer.env, latents, None, seeds, frames=True)
    film = renderer.env.films(*clips)
    shown = np.linspace(0, len(film) - 1, LOOP_PICTURES).round().astype(int)
    pictures = [Image.fromarray(film[i][:, 2 * WIDTH :]) for i in shown]
    pictures[-1].save(folder / f"{info.family}.webp", quality=70)
    how = {"append_images": pictures[1:], "duration": LOOP_MILLISECONDS, "loop": 2, "quality": 50}
    pictures[0].save(folder / f"{info.family}-loop.webp", save_all=True, **how)


def page(model: str, wish: str, answers: list[str], folder: Path) -> None:
    """The page after some answers, at the end of the films, on a desktop and on a phone."""
    from playwright.sync_api import sync_playwright

    screens = {
        "desktop": {"viewport": {"width": 1280, "height": 800}},
        "phone": {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True},
    }
    ready = "n => view?.answered === n && view.phase === 'question' && !busy"
    to_the_end = "bar => { bar.value = bar.max; bar.dispatchEvent(new Event('input')); }"
    with tempfile.TemporaryDirectory() as store, sync_playwright() as playwright:
        command = [sys.executable, "-m", "sb3_poem", "label", "--model", model, "--store", store]
        command += ["--port", "0", "--seed", "3"]
        server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        chromium = shutil.which("chromium") or shutil.which("chromium-browser")
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        try:
            address = re.search(r"http://[\d.:]+", server.stdout.readline())[0]
            for name, screen in screens.items():
                shown = browser.new_page(reduced_motion="reduce", **screen)
                shown.set_default_timeout(180_000)
                shown.goto(address)
                shown.click(f"button[value={model}]")
                shown.fill("#wish", wish)
                for number, answer in enumerate(answers):
                    shown.wait_for_function(ready, arg=number)
                    shown.click(f'[data-preference="{answer}"]')
                shown.wait_for_function(ready, arg=len(answers))
                shown.locator("#frame").evaluate(to_the_end)
                shown.wait_for_timeout(1000)  # until the films are there
                picture = Image.open(io.BytesIO(shown.screenshot()))
                picture.quantize(256).save(folder / f"label-{name}.png", optimize=True)
        finally:
            browser.close()
            server.terminate()
            server.wait()


def adapted(env: gym.Env) -> AdaptedPolicy:
    """The policy of the family's model after ten answers."""
    oracle = sb3_poem.ReturnOracle()
    return sb3_poem.PreferenceAdapter(env.spec.name, env, oracle=oracle, seed=2).adapt()


if __name__ == "__main__":
    ROBOTS.mkdir(exist_ok=True)
    for name in sorted(model.name for model in find_models()):
        both(name, ROBOTS)
    page("AntGoal", "go back, to the right", ["left", "much right"], STATIC)
    before_and_after("AntGoal", STATIC / "before-and-after.webp", task="-2.1 -2")
    families = STATIC / "environments"
    families.mkdir(exist_ok=True)
    for spec in list(gym.registry.values()):
        if spec.namespace == "poem":
            still(spec.id, families / f"{spec.name}.webp")
