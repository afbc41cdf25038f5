"""The figures of Table 3 of Xu & Zhu (ICML 2025), to be printed beside ours."""

from __future__ import annotations

#: Family -> row -> (mean, standard deviation) after 1, 5 and 10 queries.
TABLE_3: dict[str, dict[str, tuple[tuple[float, float], ...]]] = {
    "HalfCheetahVel": {
        "MAML-reward": ((-201, 13), (-193, 11), (-182, 11)),
        "ANOLE": ((-173, 12), (-120, 10), (-112, 14)),
        "ANOLE-random": ((-172, 14), (-125, 13), (-115, 13)),
        "ANOLE-greedy": ((-169, 12), (-128, 18), (-115, 12)),
        "POEM": ((-65, 10), (-50, 8), (-46, 6)),
    },
    "HalfCheetahFwdBack": {
        "MAML-reward": ((-120, 130), (-40, 138), (-4, 142)),
        "ANOLE": ((503, 149), (1012, 121), (1198, 89)),
        "ANOLE-random": ((1236, 203), (1419, 108), (1483, 45)),
        "ANOLE-greedy": ((1367, 155), (1482, 91), (1493, 89)),
        "POEM": ((1689, 54), (1684, 32), (1709, 23)),
    },
    "AntGoal": {
        "MAML-reward": ((-610, 81), (-603, 85), (-602, 89)),
        "ANOLE": ((-550, 21), (-405, 29), (-380, 19)),
        "ANOLE-random": ((-551, 22), (-419, 26), (-378, 16)),
        "ANOLE-greedy": ((-560, 25), (-412, 38), (-401, 51)),
        "POEM": ((-351, 9), (-203, 12), (-202, 7)),
    },
    "AntFwdBack": {
        "MAML-reward": ((101, 11), (105, 12), (105, 11)),
        "ANOLE": ((618, 60), (830, 20), (802, 38)),
        "ANOLE-random": ((808, 38), (810, 22), (812, 29)),
        "ANOLE-greedy": ((788, 39), (806, 23), (820, 32)),
        "POEM": ((1030, 12), (1013, 56), (1015, 48)),
    },
    "AntDir2D": {
        "MAML-reward": ((102, 20), (101, 23), (112, 30)),
        "ANOLE": ((308, 45), (515, 78), (588, 67)),
        "ANOLE-random": ((181, 30), (432, 45), (498, 35)),
        "ANOLE-greedy": ((172, 20), (443, 30), (414, 25)),
        "POEM": ((671, 15), (732, 45), (749, 40)),
    },
    "AntVel": {
        "MAML-reward": ((-3, 9), (-1, 10), (6, 8)),
        "ANOLE": ((36, 5), (80, 10), (83, 7)),
        "ANOLE-random": ((20, 5), (60, 10), (100, 6)),
        "ANOLE-greedy": ((30, 5), (70, 10), (110, 5)),
        "POEM": ((95, 5), (108, 8), (112, 4)),
    },
    "HumanoidDir2D": {
        "MAML-reward": ((504, 52), (529, 56), (523, 58)),
        "ANOLE": ((754, 59), (703, 55), (722, 62)),
        "ANOLE-random": ((232, 54), (780, 64), (796, 58)),
        "ANOLE-greedy": ((231, 30), (781, 59), (798, 54)),
        "POEM": ((812, 45), (1462, 14), (1451, 67)),
    },
    "MetaWorldML10": {
        "MAML-reward": ((153, 18), (164, 19), (166, 15)),
        "ANOLE": ((238, 31), (192, 42), (240, 21)),
        "ANOLE-random": ((242, 31), (192, 39), (229, 29)),
        "ANOLE-greedy": ((239, 34), (175, 26), (183, 13)),
        "POEM": ((326, 17), (324, 13), (349, 7)),
    },
    "MetaWorldML1": {
        "MAML-reward": ((680, 36), (691, 40), (692, 49)),
        "ANOLE": ((1086, 67), (1042, 70), (1018, 82)),
        "ANOLE-random": ((1117, 64), (1045, 80), (1145, 52)),
        "ANOLE-greedy": ((1091, 47), (1011, 67), (1122, 76)),
        "POEM": ((1435, 12), (1588, 32), (1601, 13)),
    },
}
QUERIES = (1, 5, 10)


def paper_figure(family: str, row: str | None, queries: int) -> tuple[float, float] | None:
    """What the paper reports.

    :param family: The family's name.
    :param row: A row of the table.
    :param queries: After how many queries.
    :return: Mean and standard deviation; None if it reports nothing.
    """
    figures = TABLE_3.get(family, {}).get(row or "")
    if figures is None or queries not in QUERIES:
        return None
    mean, deviation = figures[QUERIES.index(queries)]
    return float(mean), float(deviation)
