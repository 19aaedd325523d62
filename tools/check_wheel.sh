#!/bin/sh
# Build the wheel, install it into a clean environment outside the checkout, and solve with it.
set -eu
checkout=$(cd "$(dirname "$0")/.." && pwd)
outside=$(mktemp -d)
trap 'rm -rf "$outside"' EXIT
"$checkout/.venv/bin/python" -m pip wheel --quiet --disable-pip-version-check --no-deps \
    -w "$outside" "$checkout"
"$checkout/.venv/bin/python" -m venv "$outside/venv"
"$outside/venv/bin/python" -m pip install --quiet --disable-pip-version-check --no-compile \
    "$outside"/*.whl
cd "$outside"
venv/bin/halbach-fe doctor
venv/bin/halbach-fe solve "$checkout/studies/quadrupole/study.toml" -o quadrupole --json
test -s quadrupole/field_map.h5
