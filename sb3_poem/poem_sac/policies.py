"""Policy of POEMSAC: PEARLSAC's, with a reward and a policy embedding of the latent."""

from typing import Any

import torch as th
from torch.nn.functional import normalize

from sb3_poem.common.networks import MLP
from sb3_poem.pearl_sac.policies import LatentPolicy


class POEMPolicy(LatentPolicy):
    """Adds the embeddings f_r and f_pi of section 5.1 (Xu & Zhu 2025), if ``two_encoder``; they are
    compared by their inner product, or with a ``temperature`` by the cosine of their angle over it.

    >>> from sb3_poem import POEMSAC
    >>> layers = dict(layer_norm=True, net_arch=[64, 64])
    >>> model = POEMSAC("MlpPolicy", "poem/PointGoal-v0", n_train_tasks=4, policy_kwargs=layers)
    >>> isinstance(model.policy, POEMPolicy)
    True
    """

    def __init__(
        self, *args: Any, two_encoder: bool = True, temperature: float | None = None, **kwargs: Any
    ) -> None:
        self.two_encoder, self.temperature = two_encoder, temperature
        super().__init__(*args, **kwargs)

    def _build_embeddings(self, net_arch: list[int]) -> None:
        if self.two_encoder:
            self.policy_mapping = MLP(self.latent_dim, self.latent_dim, net_arch)
            self.reward_mapping = MLP(self.latent_dim, self.latent_dim, net_arch)

    def policy_embedding(self, latents: th.Tensor) -> th.Tensor:
        """z_pi = f_pi(z) of latents (..., latent_dim)."""
        return self.policy_mapping(latents) if self.two_encoder else latents

    def reward_embedding(self, latents: th.Tensor) -> th.Tensor:
        """z_r = f_r(z) of latents (..., latent_dim)."""
        return self.reward_mapping(latents) if self.two_encoder else latents

    def similarity(self, task_latents: th.Tensor, policy_latents: th.Tensor) -> th.Tensor:
        """S(z_i, z_j) (eq. 3): (m, d), (n, d) -> (m, n)."""
        policies = self.policy_embedding(policy_latents)
        return self.compare(self.reward_embedding(task_latents), policies)

    def compare(self, rewards: th.Tensor, policies: th.Tensor) -> th.Tensor:
        """S of embeddings z_r (m, d) and z_pi (n, d): (m, n)."""
        if self.temperature is None:
            return rewards @ policies.T
        return normalize(rewards) @ normalize(policies).T / self.temperature

    def _get_constructor_parameters(self) -> dict[str, Any]:
        own = {"two_encoder": self.two_encoder, "temperature": self.temperature}
        return super()._get_constructor_parameters() | own


MlpPolicy = POEMPolicy
