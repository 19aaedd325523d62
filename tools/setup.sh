#!/bin/sh
# Make this checkout ready: GetDP, Python and the libraries of the Gmsh wheel from the system's
# packages, this package in .venv. Does nothing that is done already.
#
#   tools/setup.sh [EXTRA]      EXTRA: an optional-dependencies group of pyproject.toml
set -eu
cd "$(dirname "$0")/.."
extra=${1:-}
python=${PYTHON:-python3}

# --- system packages ------------------------------------------------------------------------
libraries="libgl1 libglu1-mesa libxcursor1 libxft2 libxinerama1 libxrender1"
missing=""
getdp=${HALBACH_FE_GETDP:-getdp}
command -v "$getdp" >/dev/null 2>&1 || missing="getdp libopenblas0-pthread"
usable="import ensurepip, sys, venv; sys.exit(sys.version_info < (3, 11))"
"$python" -c "$usable" >/dev/null 2>&1 || missing="$missing python3 python3-venv"
if command -v dpkg >/dev/null 2>&1; then
    for package in $libraries; do
        # an i386 or renamed variant (libgl1:amd64, libfoo1t64) counts as well
        dpkg-query -W -f '${Status}\n' "$package" "${package}t64" 2>/dev/null |
            grep -q "install ok installed" || missing="$missing $package"
    done
fi
if [ -n "$missing" ]; then
    if ! command -v apt-get >/dev/null 2>&1; then
        echo "This system has no apt-get. Please install by hand, then run again:" >&2
        echo "  GetDP 3.2 or later with PETSc and MUMPS, from https://getdp.info; then" >&2
        echo "    export HALBACH_FE_GETDP=/path/to/getdp" >&2
        echo "  Python 3.11 or later with venv" >&2
        exit 1
    fi
    as_root=""
    if [ "$(id -u)" -ne 0 ]; then
        if command -v sudo >/dev/null 2>&1; then
            as_root="sudo"
        else
            echo "Neither root nor sudo here. Please have these two commands run as root, then run again:" >&2
            echo "  apt-get update" >&2
            echo "  apt-get install -y --no-install-recommends$(printf ' %s' $missing)" >&2
            exit 1
        fi
    fi
    echo "Installing from the distribution:$(printf ' %s' $missing)"
    $as_root apt-get update -qq
    # shellcheck disable=SC2086
    DEBIAN_FRONTEND=noninteractive $as_root apt-get install -y -qq --no-install-recommends $missing >/dev/null
fi
if ! "$python" -c "$usable" >/dev/null 2>&1; then
    echo "Python 3.11 or later with venv is needed, but $python is $("$python" --version 2>&1)." >&2
    echo "Install a newer one and run again with PYTHON=/path/to/python3." >&2
    exit 1
fi

# --- this package ---------------------------------------------------------------------------
stamp=.venv/.installed${extra:+-$extra}
if [ ! -e "$stamp" ] || [ pyproject.toml -nt "$stamp" ]; then
    echo "Installing halbach-fe into .venv"
    [ -x .venv/bin/python ] || "$python" -m venv .venv
    .venv/bin/python -m pip install --quiet --disable-pip-version-check -e ".${extra:+[$extra]}"
    touch "$stamp"
fi
