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
extras=$extra
if ! command -v "$getdp" >/dev/null 2>&1; then
    if [ "$(uname -sm)" != "Linux x86_64" ] || { command -v apt-get >/dev/null 2>&1 &&
            { [ "$(id -u)" -eq 0 ] || command -v sudo >/dev/null 2>&1; }; }; then
        missing="getdp"
    else  # nobody here may install it: take the static build, a package of PyPI
        extras=${extra:+$extra,}getdp
    fi
fi
if [ "$extra" = test ]; then  # pages are opened in the one, runs shared by the other
    command -v chromium >/dev/null 2>&1 || missing="$missing chromium"
    command -v mpirun >/dev/null 2>&1 || missing="$missing openmpi-bin"
fi
usable="import ensurepip, sys, venv; sys.exit(sys.version_info < (3, 11))"
"$python" -c "$usable" >/dev/null 2>&1 || missing="$missing python3 python3-venv"
if command -v dpkg >/dev/null 2>&1; then
    for package in $libraries; do
        # an i386 or renamed variant (libgl1:amd64, libfoo1t64) counts as well
        dpkg-query -W -f '${Status}\n' "$package" "${package}t64" 2>/dev/null |
            grep -q "install ok installed" || missing="$missing $package"
    done
    # without another BLAS Debian's GetDP gets the reference one, and factorizes 4 to 5 times slower
    case "$missing $(readlink -f /usr/lib/*/libblas.so.3)" in
        *getdp* | */blas/libblas.so*)
            faster=libopenblas0-pthread
            if [ -n "$missing" ]; then
                missing="$missing $faster"
            elif [ ! -e .venv ]; then  # nothing needs it: try once
                { [ "$(id -u)" -eq 0 ] && apt-get update -qq && DEBIAN_FRONTEND=noninteractive \
                    apt-get install -y -qq --no-install-recommends "$faster"; } >/dev/null 2>&1 ||
                    echo "3D would be faster with: apt-get install $faster" >&2
            fi ;;
    esac
fi
if [ -n "$missing" ]; then
    if ! command -v apt-get >/dev/null 2>&1; then
        echo "This system has no apt-get. Unpack a GetDP with PETSc and MUMPS from" >&2
        echo "https://getdp.info, have Python 3.11 or later with venv, and run" >&2
        echo "  export HALBACH_FE_GETDP=/path/to/getdp PYTHON=/path/to/python3" >&2
        echo "  make demo" >&2
        exit 1
    fi
    by_hand() {
        echo "$1 Please have these two commands run as root, then run again:" >&2
        echo "  apt-get update" >&2
        echo "  apt-get install -y --no-install-recommends$(printf ' %s' $missing)" >&2
        exit 1
    }
    as_root=""
    if [ "$(id -u)" -ne 0 ]; then
        command -v sudo >/dev/null 2>&1 || by_hand "Neither root nor sudo here."
        as_root="sudo"
    fi
    echo "Installing from the distribution:$(printf ' %s' $missing)"
    $as_root apt-get update -qq || by_hand "Installing did not work."
    # shellcheck disable=SC2086
    $as_root env DEBIAN_FRONTEND=noninteractive \
        apt-get install -y -qq --no-install-recommends $missing >/dev/null ||
        by_hand "Installing did not work."
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
    .venv/bin/python -m pip install --quiet --disable-pip-version-check -e ".${extras:+[$extras]}"
    touch "$stamp" .venv/.installed  # an extra's installation is that of the package, too
fi
