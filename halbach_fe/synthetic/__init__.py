"""Synthetic campaigns, whose truth does not come from the model of the field that they test.

magpylib and NGSolve come with the optional extra ``campaign``.
"""
