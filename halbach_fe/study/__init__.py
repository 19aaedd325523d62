"""The study file: a magnet, its measurement and what is known beforehand, as one TOML document."""
