"""A model of ML10 by Meta-World's own evaluation: its environments, goals, horizon and criterion.

    python benchmarks/metaworld_evaluation.py [--model pretrained/MetaWorldML10] [--split test]

``metaworld.evaluation.metalearning_evaluation`` draws goals of the five manipulations that ML10
holds back (``--split train``: of the ten to train on), and plays episodes of up to 500 steps, each
a success if it is one at its end, which a success brings. In the place of its episodes with rewards
the model adapts by answers: exact ones, about Meta-World's return of 200 steps in the same
placement. Writes ``<OUT>/metaworld-evaluation-<split>.md``.
"""

from typing import Any

import numpy as np
from common import RESULTS, arguments, table, write
from metaworld import make_ml_envs
from metaworld.env_dict import ALL_V3_ENVIRONMENTS
from metaworld.evaluation import metalearning_evaluation

from sb3_poem import Bayes, ReturnOracle
from sb3_poem.adaptation import adapt_tasks
from sb3_poem.common.vec_env import make_task_vec_env
from sb3_poem.loading import load_model


class Adapted:
    """Meta-World's agent: adapts to the goals that its environments have when it is called."""

    def __init__(self, model: Any, envs: Any, split: str, n_queries: int) -> None:
        self.model, self.envs, self.n_queries, self.seed = model, envs, n_queries, 0
        split = "held-out" if split == "test" else split
        self.family = make_task_vec_env(model.env_id, 2 * envs.num_envs, split=split)
        self.dim = self.family.get_attr("task_space", [0])[0].shape[0]
        manipulations = self.family.get_attr("manipulations", [0])[0]
        classes = [ALL_V3_ENVIRONMENTS[f"{name}-v3"].__name__ for name in manipulations]
        self.numbers = {name: i for i, name in enumerate(classes)}

    def init(self) -> None:
        tasks = np.zeros((self.envs.num_envs, self.dim))
        for task, env in zip(tasks, self.envs.envs, strict=True):
            placement = env.unwrapped._last_rand_vec
            task[0], task[1 : 1 + len(placement)] = self.numbers[env.unwrapped.task_name], placement
        how = {"rule": Bayes(), "n_queries": max(1, self.n_queries), "record_at": [self.n_queries]}
        found = adapt_tasks(self.model, self.family, tasks, ReturnOracle, seed=self.seed, **how)
        self.latents, self.seed = found.latents[:, -1], self.seed + len(tasks)

    def reset(self, env_mask: np.ndarray) -> None:
        """A policy that knows its latent remembers nothing."""

    def eval_action(self, observations: np.ndarray) -> np.ndarray:
        return self.model.predict(observations, state=self.latents, deterministic=True)[0]


def main() -> None:
    args = arguments(
        __doc__,
        model="pretrained/MetaWorldML10",
        split={"choices": ("test", "train"), "default": "test"},
        answers=[0, 10],
        evals=5,
        out={"type": type(RESULTS), "default": RESULTS / "MetaWorldML10"},
    )
    model, rows = load_model(args.model), {}
    for n_queries in args.answers:
        how = {"task_select": "pseudorandom", "terminate_on_success": True}
        envs = make_ml_envs("ML10", 1, 20, total_tasks_per_cls=40, split=args.split, **how)
        agent = Adapted(model, envs, args.split, n_queries)
        success, _, each = metalearning_evaluation(agent, envs, args.evals, adaptation_steps=0)
        rows[n_queries] = {"mean": success, **each}
        print(n_queries, rows[n_queries], flush=True)
        envs.close()
        agent.family.close()
    names = [*sorted(set(each)), "mean"]
    head = ["manipulation", *(f"after {k} answers" for k in rows)]
    shares = [[name, *(f"{row[name]:.2f}" for row in rows.values())] for name in names]
    text = f"{args.evals} draws of 20 goals, 3 episodes each; success rates. Rewards version 2."
    name, title = f"metaworld-evaluation-{args.split}", "ML10 by Meta-World's own evaluation"
    write(name, title, [text, table(head, shares)], None, args.out, {})


if __name__ == "__main__":
    main()
