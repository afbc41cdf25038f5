"""The benchmark: the paper's comparisons and ablations as cells of declared suites, kept in one
store.
"""
