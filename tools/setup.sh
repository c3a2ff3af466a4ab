#!/bin/sh
# Set-up steps behind the Makefile:   tools/setup.sh venv|opengl|extras NAME,NAME
#
#   venv    make .venv with a current pip (python3-venv is installed when missing)
#   extras  see that setup.cfg has extras of these names
#   opengl  see that .venv can open a headless OpenGL context (Mesa's libraries are installed when missing)
#
# What is missing is installed with apt-get when this runs as root; otherwise the one command to type is printed and the
# script stops with status 1. The steps are quick and change nothing when there is nothing to do.
set -eu

venv=.venv
python=$venv/bin/python

# need PACKAGES WHY: install with apt-get as root, or say how to.
need() {
    echo "$2" >&2
    if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
        echo "installing with apt-get: $1" >&2
        # The first install may fail on a stale or empty package list, which is then fetched.
        # shellcheck disable=SC2086
        DEBIAN_FRONTEND=noninteractive apt-get install -y -q --no-install-recommends $1 >/dev/null 2>&1 || {
            apt-get update -q >/dev/null
            DEBIAN_FRONTEND=noninteractive apt-get install -y -q --no-install-recommends $1 >/dev/null
        }
    elif command -v apt-get >/dev/null; then
        echo "please run:   sudo apt-get install -y --no-install-recommends $1" >&2
        exit 1
    else
        echo "please install what your system calls: $1" >&2
        exit 1
    fi
}

# The first Python >= 3.11: $PYTHON, python3, or one with its version in the name.
find_python() {
    for candidate in ${PYTHON:-} python3 python3.13 python3.12 python3.11; do
        if "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
            command -v "$candidate"
            return
        fi
    done
    return 1
}

make_venv() {
    # One whose Python is gone, or that was made without pip, is made anew.
    if "$python" -c 'import pip' 2>/dev/null; then return; fi
    base=$(find_python) || {
        need "python3 python3-venv" "there is no Python 3.11 or newer"
        base=$(find_python) || { echo "still no Python 3.11 or newer; set PYTHON=/path/to/python3" >&2; exit 1; }
    }
    if ! "$base" -c 'import venv, ensurepip' 2>/dev/null; then  # Debian and Ubuntu ship Python without them
        need "python3-venv" "Python's venv module is missing"
    fi
    echo "making $venv with $("$base" --version)"
    rm -rf "$venv"
    "$base" -m venv "$venv"
}

context_opens() {
    "$python" - <<'EOF'
import sys
from blinkgl.errors import GLError
from blinkgl.gl import create_context
try:
    with create_context() as gl:
        print(f"OpenGL: {gl.backend}, {gl.renderer}, {'software' if gl.is_software else 'GPU'}")
except GLError as error:
    print(error, file=sys.stderr)
    sys.exit(1)
EOF
}

check_opengl() {
    context_opens 2>/dev/null && return
    packages="libegl1 libgl1 libgl1-mesa-dri"
    # Mesa dropped OSMesa in 25.1; where it is still packaged it makes a second way.
    if apt-cache show libosmesa6 >/dev/null 2>&1; then packages="$packages libosmesa6"; fi
    need "$packages" "there is no OpenGL to render with"
    context_opens
}

# pip only warns about an extra that does not exist.
check_extras() {
    known=$("$python" -c 'from importlib.metadata import metadata; print(*metadata("blinkgl").get_all("Provides-Extra"))')
    for extra in $(echo "$1" | tr , ' '); do
        case " $known " in
            *" $extra "*) ;;
            *) echo "there is no extra '$extra'; expected some of: $known (docs/install.md says what each brings)" >&2; exit 1 ;;
        esac
    done
}

case "${1:-}" in
    venv) make_venv ;;
    extras) check_extras "${2:-}" ;;
    opengl) check_opengl ;;
    *) echo "usage: tools/setup.sh venv|opengl|extras NAME,NAME" >&2; exit 2 ;;
esac
