"""The inference of block magnetizations from measurements, and where the maps lie in the magnet.

`infer` updates `block_prior` by `campaign_readings`, again where these are not linear
(`relinearization`), with `mcmc` if iron saturates, and writes `posterior_files`. `registration`
searches for the pose of a map (`pose_search`) and fits it (`pose_fit`).
"""
