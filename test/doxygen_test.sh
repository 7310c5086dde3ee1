#!/usr/bin/env bash
# Fails when doxygen has anything to warn of. Usage: doxygen_test.sh SOURCE
set -euo pipefail
cd "$1"
if ! command -v doxygen >/dev/null; then
  echo "left out: doxygen is not installed"
  exit 77
fi
out=$(mktemp -d)
trap 'rm -rf "$out"' EXIT
if (cat docs/Doxyfile; echo "OUTPUT_DIRECTORY = $out") | doxygen - 2>&1 | grep .; then
  exit 1
fi
[ -s "$out/html/index.html" ]
