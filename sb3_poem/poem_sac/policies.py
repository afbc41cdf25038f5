"""Policy of POEMSAC: PEARLSAC's, with a reward and a policy embedding of the latent."""

from typing import Any

import torch as th

from sb3_poem.common.networks import MLP
from sb3_poem.pearl_sac.policies import LatentPolicy


class POEMPolicy(LatentPolicy):
    """Adds the embeddings f_r and f_pi of section 5.1 (Xu & Zhu 2025), if ``two_encoder``."""

    def __init__(self, *args: Any, two_encoder: bool = True, **kwargs: Any) -> None:
        self.two_encoder = two_encoder
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
        """S(z_i, z_j) = <f_r(z_i), f_pi(z_j)> (eq. 3): (m, d), (n, d) -> (m, n)."""
        return self.reward_embedding(task_latents) @ self.policy_embedding(policy_latents).T

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), "two_encoder": self.two_encoder}


MlpPolicy = POEMPolicy
