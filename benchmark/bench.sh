#!/usr/bin/env bash
# The benchmarks; called by `./run bench`.
set -euo pipefail

usage() {
  cat <<'TXT'
./run bench [--quick] [--out DIR] [parts | compare | accuracy | scaling | camera | calibration [OPTION…]]

  parts      Google Benchmark: lenses, renderer, views, the sweep
  compare    the sweep beside OpenCV's matchers on the same rendered pair, at 1280x960 and 3060x2036,
             one thread and all: times as ratios, memory, density, errors
  accuracy   errors of the sweep by field angle on further scenes; phase bias; more than two positions
  scaling    cost by pixels, hypotheses, positions and threads, with a plot
  camera     processor time of the camera driver beside a bare Aravis loop, on Debian's software camera
  calibration  lenses, calibration and detection beside the limits that they are held to; names choose
             among them (recorded corners lenses simulation stage time detection scan)

Without a name: all but calibration. Options after a name go to it (`./run bench compare --help`). --quick: fewer
runs and the small size only. Results go to DIR too (JSON, CSV, SVG). OMNISTER_SIMD=avx2 or scalar holds
the sweep to narrower registers.
TXT
}

out=
quick=
while [ $# -gt 0 ]; do
  case "$1" in
    --quick) quick=yes ;;
    --out) out=${2:?--out needs a folder}; shift ;;
    -h | --help) usage; exit 0 ;;
    *) break ;;
  esac
  shift
done
if [ -n "$out" ]; then
  mkdir -p "$out"
  out=$(cd "$out" && pwd)
fi
here=$(cd "$(dirname "$0")" && pwd)
part=${1:-all}
[ $# -gt 0 ] && shift

parts() {
  omnister_bench_core --benchmark_min_time="$([ -n "$quick" ] && echo 0.05 || echo 0.3)" \
    ${out:+--benchmark_out="$out/parts.json"} "$@"
}
stereo() { omnister_bench_stereo ${out:+--out "$out"} "$@"; }
compare() {
  if [ -n "$quick" ]; then
    stereo --suite compare --runs 3 "$@"
  elif [[ " $* " == *" --size "* ]]; then
    stereo --suite compare "$@"
  else
    stereo --suite compare --size 1280x960 3060x2036 --thesis-rows 480 "$@"
  fi
}

# 77: there is no camera to measure on.
camera() { /usr/bin/python3 "$here/camera_cost.py" "$@" || [ $? -eq 77 ]; }
calibration() { omnister_bench_calibration ${out:+--out "$out"} "$@"; }

case "$part" in
  all)
    parts
    compare
    stereo --suite accuracy
    stereo --suite scaling --runs "$([ -n "$quick" ] && echo 3 || echo 5)"
    camera --rounds "$([ -n "$quick" ] && echo 1 || echo 5)"
    ;;
  parts) parts "$@" ;;
  compare) compare "$@" ;;
  accuracy) stereo --suite accuracy "$@" ;;
  scaling) stereo --suite scaling "$@" ;;
  camera) camera "$@" ;;
  calibration) calibration "$@" ;;
  *)
    usage >&2
    exit 2
    ;;
esac
