"""The study file: one TOML document of a magnet, its measurement and the prior knowledge of it.

`model` is the whole study, ``…_keys`` are its tables; `reader` checks a file, `writer` writes it.
"""
