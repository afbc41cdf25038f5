"""Meta-batches of groups of tasks, within which returns are known."""

from dataclasses import dataclass

import numpy as np

from sb3_poem.pearl_sac.sampler import MetaBatchSampler


@dataclass
class GroupSampler(MetaBatchSampler):
    """Draws meta-batches of whole groups of tasks, where policies are compared within these."""

    groups: list[np.ndarray]
    preference_group_size: int

    def choose_tasks(self) -> np.ndarray:
        if not len(self.groups):
            return super().choose_tasks()
        wanted = self.meta_batch_size // self.preference_group_size
        count = max(1, min(wanted, len(self.groups)))
        chosen = self.generators.numpy.choice(len(self.groups), size=count, replace=False)
        return np.concatenate([self.groups[index] for index in chosen])
