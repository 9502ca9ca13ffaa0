#!/usr/bin/env bash
# The system libraries that the wheels expect: open3d and pyrender load GL, EGL, X11 and USB libraries at run time.
# Installs only what is missing, through apt; without the rights to do so it says what to run.
set -euo pipefail

missing=()
need() { ldconfig -p 2>/dev/null | grep -q "$1" || missing+=("$2"); }
# ldconfig lives in /sbin, which an ordinary user's PATH may lack.
export PATH="$PATH:/usr/sbin:/sbin"
need 'libGL\.so\.1' libgl1
need 'libEGL\.so\.1' libegl1
need 'libX11\.so\.6' libx11-6
need 'libusb-1\.0\.so\.0' libusb-1.0-0
need 'libgomp\.so\.1' libgomp1
if ! ls /usr/lib/*/dri/*_dri.so /usr/lib/*/libgallium-*.so >/dev/null 2>&1; then missing+=(libgl1-mesa-dri); fi
if ! ls /usr/lib/*/libEGL_mesa.so.0 /usr/lib/*/libEGL_nvidia.so.0 >/dev/null 2>&1; then missing+=(libegl-mesa0); fi
# Debian splits venv from python3; without ensurepip `python3 -m venv` fails.
if ! "${PYTHON:-python3}" -c 'import ensurepip, venv' >/dev/null 2>&1; then missing+=(python3-venv); fi

if [ "${#missing[@]}" -eq 0 ]; then exit 0; fi
echo "missing system libraries: ${missing[*]}"
if ! command -v apt-get >/dev/null 2>&1; then
  echo "this is no Debian-like system: install the counterparts of these packages, then run make again" >&2
  exit 1
fi
run=()
if [ "$(id -u)" -ne 0 ]; then
  if command -v sudo >/dev/null 2>&1; then run=(sudo); else
    echo "as root run: apt-get install -y --no-install-recommends ${missing[*]}" >&2
    exit 1
  fi
fi
"${run[@]}" apt-get update -qq
"${run[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "${missing[@]}"
