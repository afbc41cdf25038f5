"""The paper's comparisons and ablations: cells of declared suites, kept in one store."""
