#!/bin/sh
# Build the wheel, install it into a clean environment outside the checkout, and run the main commands
# there without root and without any GetDP but that of `halbach-fe[getdp]`.
set -eu
checkout=$(cd "$(dirname "$0")/.." && pwd)
outside=$(mktemp -d)
trap 'rm -rf "$outside"' EXIT
"$checkout/.venv/bin/python" -m pip wheel --quiet --disable-pip-version-check --no-deps \
    -w "$outside" "$checkout"
"$checkout/.venv/bin/python" -m venv "$outside/venv"
"$outside/venv/bin/python" -m pip install --quiet --disable-pip-version-check \
    "$(echo "$outside"/*.whl)[getdp]"
cd "$outside"

# root becomes nobody in a user namespace, where there may be such
without_root=$({ [ "$(id -u)" -eq 0 ] && unshare --user true 2>/dev/null && echo unshare --user; } || true)
alone() {
    echo "without root: $*"
    $without_root env PATH="$outside/venv/bin" HOME="$outside" "$outside/venv/bin/$@"
}
cat >first.py <<'END'
import numpy as np
import halbach_fe as hf

magnet = hf.halbach_ring(blocks=8, inner_radius_m=0.03, outer_radius_m=0.05, length_m=0.06)
points_m = np.random.default_rng(1).uniform(-0.015, 0.015, (120, 3))
noise_T = 1e-4 * np.random.default_rng(2).standard_normal(points_m.shape)
hf.write_study(magnet, "magnet.toml")
hf.write_map(hf.field_map(points_m, magnet.field_T(points_m) + noise_T, 1e-4), "map.csv")
END
alone halbach-fe doctor
alone python first.py
alone halbach-fe explain magnet.toml map.csv -o explained
alone halbach-fe solve "$checkout/studies/quadrupole/study.toml" -o quadrupole --json  # with iron
test -s explained/explanation.html
test -s quadrupole/field_map.h5
echo "4 of 4 commands ran without root"
