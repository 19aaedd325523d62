"""The study file: one TOML document of a magnet, its measurement and the prior knowledge of it."""
