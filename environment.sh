#!/bin/sh
# Makes .venv with everything that the demo and the tests need, at the versions of constraints.txt.
set -eu
[ -x .venv/bin/python ] || "$PYTHON" -m venv .venv
export PIP_DISABLE_PIP_VERSION_CHECK=1

# The oldest Blender that the extension supports runs in this Python and shares the other packages.
oldest=4.5.15
# The others want a Python of their own; where there is none their tests skip.
newer="5.2.3 5.3.0"
install_blenders() {
    [ -d ".venv/blender-4.5/bpy-$oldest.dist-info" ] ||
        .venv/bin/python -m pip install --quiet --no-deps --upgrade --target .venv/blender-4.5 "bpy==$oldest"
    for python in python3.13 "$HOME"/.pyenv/versions/3.13.*/bin/python3.13; do
        "$python" -m pip -V >/dev/null 2>&1 || continue
        for version in $newer; do
            folder=".venv/blender-${version%.*}"
            [ -d "$folder/bpy-$version.dist-info" ] && continue
            "$python" -m pip install --quiet --upgrade --root-user-action ignore --target "$folder" "bpy==$version"
            ln -sf "$("$python" -c "import sys; print(sys.executable)")" "$folder/python"
        done
        return
    done
}
trap wait EXIT
install_blenders &
.venv/bin/python -m pip install --quiet --constraint constraints.txt --requirement requirements-dev.txt
wait $!

# Blender as a Python package links to the system's OpenGL and X11 libraries even when it draws nothing on a screen.
libraries="libgl1 libegl1 libgl1-mesa-dri libsm6 libxi6 libxrender1 libxfixes3 libxkbcommon0"
if ! .venv/bin/python -c "import bpy" 2>/dev/null; then
    if command -v apt-get >/dev/null && [ "$(id -u)" = 0 ]; then
        apt-get update -qq
        DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $libraries >/dev/null
    fi
    .venv/bin/python -c "import bpy" || {
        echo "Blender's Python package does not load. Install these system libraries (their names in Debian and Ubuntu) and try again: $libraries" >&2
        exit 1
    }
fi
.venv/bin/python -m swag_engine.kernels.build
