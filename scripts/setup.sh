#!/usr/bin/env bash
# Make the virtual environment FOLDER with bathynerf in it, and find or install the system libraries.
#   scripts/setup.sh FOLDER EXTRAS
# EXTRAS are those of pyproject.toml, separated by commas. Versions are those of constraints.txt. uv installs them,
# within a tenth of pip's time, with pip's settings of this machine; where there is no uv for this machine, pip does.
# PYTHON names an interpreter; without it the first that pyproject.toml allows is taken.
# Packages of the system are installed where this runs as root on Debian or Ubuntu; elsewhere it says which and how.
set -euo pipefail
cd "$(dirname "$0")/.."

venv=$1
extras=$2
# Dr.Jit needs libatomic.so.1, and libLLVM 17 or newer; older ones have no x86 code for its minimum and maximum.
llvm_packages=(libllvm19 libllvm18 libllvm17)

say() { printf '%s\n' "$*"; }
fail() {
    printf 'error: %s\n' "$*" >&2
    exit 1
}

can_install() { [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; }

# The first of the named packages that the system's repositories have is installed; fails if none can be.
apt_updated=
install_first_of() {
    can_install || return 1
    export DEBIAN_FRONTEND=noninteractive
    if [ -z "$apt_updated" ]; then
        apt-get update -qq || return 1
        apt_updated=yes
    fi
    local package
    for package in "$@"; do
        if apt-cache show "$package" >/dev/null 2>&1; then
            say "Installing the system package $package"
            apt-get install -y -qq --no-install-recommends "$package" </dev/null >/dev/null && return 0
        fi
    done
    return 1
}

# "3.11 3.12 3.13 3.14" from the line requires-python = ">=3.11,<3.15"
versions=$(sed -nE 's/^requires-python = ">=3\.([0-9]+),<3\.([0-9]+)".*/\1 \2/p' pyproject.toml |
    { read -r low high && seq -f '3.%g' -s ' ' "$low" $((high - 1)); })

is_allowed() {
    [[ " $versions " == *" $("$1" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null) "* ]]
}

find_python() {
    local candidate
    for candidate in ${PYTHON:-$(printf 'python%s ' $versions) python3}; do
        if is_allowed "$candidate"; then
            command -v "$candidate"
            return
        fi
    done
    return 1
}

make_venv() {
    local python version
    python=$(find_python) || fail "no Python of the versions $versions was found${PYTHON:+ as $PYTHON};" \
        "install one (Debian 12: apt-get install python3 python3-venv) or name it: make PYTHON=/path/to/python3.11"
    version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
    if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
        install_first_of "python$version-venv" ||
            fail "$python cannot make virtual environments: install python$version-venv" \
                "(Debian, Ubuntu: sudo apt-get install -y python$version-venv libatomic1 libllvm19) and give the command again"
    fi
    say "Making $venv with $("$python" --version)"
    "$python" -m venv --clear "$venv"
}

loads_drjit() { "$venv/bin/python" -c 'import drjit' 2>/dev/null; }
has_llvm() {
    "$venv/bin/python" -c 'import sys; from fields.device import choose_device
sys.exit(choose_device("cpu").name != "llvm")'
}

is_usable() { is_allowed "$venv/bin/python" && "$venv/bin/python" -m pip --version >/dev/null 2>&1; }

# uv of the system, else one that is installed into the environment; fails if neither can be had.
find_uv() {
    command -v uv || {
        [ -x "$venv/bin/uv" ] || "$venv/bin/python" -m pip install -qq --disable-pip-version-check 'uv>=0.5.3' || return 1
        printf '%s' "$venv/bin/uv"
    }
}

install_packages() {
    local uv
    if uv=$(find_uv); then
        eval "$("$venv/bin/python" scripts/uv_settings.py)"
        "$uv" pip install -q --python "$venv/bin/python" -c constraints.txt -e ".[$extras]"
    else
        say "uv cannot be installed here; pip takes some minutes"
        "$venv/bin/python" -m pip install -qq --disable-pip-version-check --upgrade pip
        "$venv/bin/python" -m pip install -qq --progress-bar off -c constraints.txt -e ".[$extras]"
    fi
}

is_usable || make_venv
say "Installing packages into $venv ($extras)"
install_packages
if ! loads_drjit; then
    install_first_of libatomic1 || true
    loads_drjit || fail "Dr.Jit cannot be loaded; it needs libatomic.so.1. Install libatomic1" \
        "(Debian, Ubuntu: sudo apt-get install -y libatomic1 libllvm19) and give the command again;" \
        "$venv/bin/python -c 'import drjit' shows what is missing"
fi
if ! has_llvm; then
    install_first_of "${llvm_packages[@]}" || true
    has_llvm || say "note: without libLLVM 17 or newer for Dr.Jit, torch does the work, more slowly." \
        "Install one of ${llvm_packages[*]} (Debian, Ubuntu: sudo apt-get install -y libllvm19; macOS: brew install" \
        "llvm), or set DRJIT_LIBLLVM_PATH to the full path of such a library"
fi
