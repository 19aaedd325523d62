"""Find which missing effects explain the disagreement between a model and a measured map.

`diagnose` goes through the steps: `gross_errors`, `random_errors`, then in every round
`linearization`, `effect_comparison` of the catalogue (`effects`), `effect_selection` by
`marginal_evidence`, `competing_causes` of any shape, and the `verdict`, which is told in `summary`.
"""
