"""Rules by their short form: words, as a command line and the sessions of the page have them."""

from typing import Any

from sb3_poem.adaptation.bayes import Bayes
from sb3_poem.adaptation.noise import MistakeNoise
from sb3_poem.adaptation.paper import Paper
from sb3_poem.adaptation.rule import Rule
from sb3_poem.common.checks import check_choice


def named_rule(
    inference: str = "bayes",
    n_candidates: int | None = None,
    mistake_rate: float | None = None,
    **options: Any,
) -> Rule:
    """The rule of these words, "bayes" or "paper"; None takes its own numbers.

    >>> named_rule("paper", n_candidates=50)
    Paper(n_candidates=50)

    :param n_candidates: Of Algorithm 2, or particles.
    :param mistake_rate: How often who answers errs, unless ``noise_model`` says how; Algorithm 2
        takes no notice of either.
    :param options: Others of the rule.
    """
    check_choice("inference", inference, ("bayes", "paper"))
    if inference == "paper":
        if (question := options.pop("question", "pair")) != "pair":
            raise ValueError(f'inference="paper" asks about pairs: leave out question="{question}"')
        options.pop("noise_model", None)
        if n_candidates is not None:
            options["n_candidates"] = n_candidates
        return Paper(**options)
    if n_candidates is not None:
        options["n_particles"] = n_candidates
    if mistake_rate is not None:
        options.setdefault("noise_model", MistakeNoise(mistake_rate))
    return Bayes(**options)
