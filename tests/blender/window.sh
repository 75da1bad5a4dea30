#!/usr/bin/env bash
# Run script.py of a folder in the real Blender, on a virtual screen of its own, until Blender ends.
#   window.sh ROOT NAME WIDTH HEIGHT [arguments for Blender]
#   ROOT: the folder made by ../shared/real-blender/setup; NAME: the folder ROOT/gui/NAME, which also gets the logs
# Variables SWAG_* and BLENDER_USER_RESOURCES are passed on. SECONDS_LIMIT ends Blender, 500 by default: pytest waits 600.
set -euo pipefail
root=${1:?usage: window.sh ROOT NAME WIDTH HEIGHT [arguments]} name=${2:?} width=${3:?} height=${4:?}; shift 4
passed=(); while read -r -d '' one; do passed+=("$one"); done < <(env -0 | grep -zE '^(SWAG_|BLENDER_USER_RESOURCES=)')
env -i PATH=/usr/sbin:/usr/bin:/sbin:/bin HOME=/root LIBGL_ALWAYS_SOFTWARE=1 GALLIUM_DRIVER=llvmpipe PYTHONUNBUFFERED=1 \
    "${passed[@]}" chroot "$root" bash -c '
    cd "/gui/$1"; width=$2 height=$3 limit=$4; shift 4
    trap "kill \$(jobs -p) 2>/dev/null" EXIT
    # The screen writes its number once it takes connections, and the window manager announces itself on it.
    Xvfb -displayfd 3 -screen 0 "${width}x${height}x24" +extension GLX +render -noreset 3>display >xvfb.log 2>&1 &
    until [ -s display ]; do kill -0 $! || exit 1; sleep 0.05; done
    export DISPLAY=:$(cat display)
    openbox >openbox.log 2>&1 &
    until xprop -root _NET_SUPPORTING_WM_CHECK | grep -q window; do kill -0 $! || exit 1; sleep 0.05; done
    timeout --kill-after=10 "$limit" \
        blender --factory-startup --window-geometry 0 0 "$width" "$height" "$@" --python script.py 2>&1
    ' window "$name" "$width" "$height" "${SECONDS_LIMIT:-500}" "$@"
