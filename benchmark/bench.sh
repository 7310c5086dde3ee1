#!/usr/bin/env bash
# The benchmarks; called by `./run bench`.
set -euo pipefail

usage() {
  cat <<'TXT'
./run bench [--quick] [--out DIR]
    [parts | compare | accuracy | presets | scaling | node | camera | calibration [OPTION…]]

  parts      Google Benchmark: lenses, renderer, views, the sweep
  compare    the sweep beside OpenCV's matchers on the same rendered pair, at 1280x960 and 3060x2036,
             one thread and all: times as ratios, memory, density, errors
  accuracy   errors of the sweep by field angle on further scenes; phase bias; more than two positions
  presets    fast, balanced and accurate in turn: time, density, errors ([RUNS])
  scaling    cost by pixels, hypotheses, positions and threads, with a plot
  node       clouds a second of the stereo node at 1280x960, image messages to published clouds
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
node() {
  # A master of its own, on a port that is free.
  local port
  port=$(/usr/bin/python3 -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])')
  export ROS_MASTER_URI=http://localhost:$port ROS_HOSTNAME=localhost
  rosmaster --core -p "$port" >/dev/null 2>&1 &
  local master=$!
  trap 'kill '"$master" EXIT
  for _ in $(seq 300); do
    rosparam list >/dev/null 2>&1 && break
    sleep 0.1
  done
  omnister_bench_node "$@"
}

case "$part" in
  all)
    parts
    compare
    stereo --suite accuracy
    omnister_bench_presets
    stereo --suite scaling --runs "$([ -n "$quick" ] && echo 3 || echo 5)"
    node --clouds "$([ -n "$quick" ] && echo 30 || echo 100)"
    camera --rounds "$([ -n "$quick" ] && echo 1 || echo 5)"
    ;;
  parts) parts "$@" ;;
  compare) compare "$@" ;;
  accuracy) stereo --suite accuracy "$@" ;;
  presets) omnister_bench_presets "$@" ;;
  scaling) stereo --suite scaling "$@" ;;
  camera) camera "$@" ;;
  calibration) calibration "$@" ;;
  node) node "$@" ;;
  *)
    usage >&2
    exit 2
    ;;
esac
