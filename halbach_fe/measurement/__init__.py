"""Measured maps and blocks: their files, how B becomes a reading, its noise, and Maxwell's check.

`probe_law` says what a probe shows of B, `observation_operator` which numbers of a map are
readings, and `reading_noise` how these scatter. `map_check` and `map_join` need no magnet: they fit
a `source_free_field` (`probe_fit`, `map_join_fit`). `formats` reads the files of other programs.
"""
