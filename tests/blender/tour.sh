#!/usr/bin/env bash
# Every stage of a user's work in the real Blender, with a screenshot of each: tour.sh ROOT EXTENSION.zip SCENE OUT
#   SCRIPT: another script than tour.py to run there
#   ROOT: the folder made by ../shared/real-blender/setup and share-venv; takes minutes on a machine without a graphics card
set -euo pipefail
root=${1:?usage: tour.sh ROOT EXTENSION.zip SCENE OUT} zip=${2:?} scene=${3:?} out=${4:?}
here=$root/gui/tour; rm -rf "$here"; mkdir -p "$here" "$out"
cp "${SCRIPT:-$(dirname "$0")/tour.py}" "$here/script.py"; cp "$(dirname "$0")/window.py" "$here"; cp "$zip" "$here/extension.zip"; cp -r "$scene" "$here/scene"
python=$(readlink -f "$(dirname "$0")/../../.venv")/bin/python
export SWAG_ENGINE_PYTHON=$python SWAG_ZIP=/gui/tour/extension.zip SWAG_SCENE=/gui/tour/scene SWAG_OUT=/gui/tour
export SWAG_CACHE_DIR=/gui/tour/cache BLENDER_USER_RESOURCES=/gui/tour/user
SECONDS_LIMIT=1200 bash "$(dirname "$0")/window.sh" "$root" tour 1920 1080 >"$here/log" || true
cp "$here"/*.png "$here/report.json" "$out"; cat "$here/report.json"
grep -q '"done": true' "$here/report.json"
