#!/usr/bin/env bash
# run.sh BUILD SECONDS [TARGET…]: every fuzz target for SECONDS, on all cores in turn (or JOBS of them); the
# corpus grows in BUILD/fuzz. Prints executions by target and in all; fails when one of them found something,
# which lies beside the corpus then.
set -euo pipefail
build=$1
seconds=$2
shift 2
cd "$(dirname "${BASH_SOURCE[0]}")/../.."
targets=("$@")
if [ ${#targets[@]} -eq 0 ]; then
  for seeds in "$build"/tests/fuzz_*.seeds; do
    name=${seeds##*/fuzz_}
    targets+=("${name%.seeds}")
  done
fi
export ASAN_OPTIONS=allocator_may_return_null=1:detect_stack_use_after_return=1
export UBSAN_OPTIONS=print_stacktrace=1

fuzz_one() {
  local name=$1 folder=$build/fuzz/$1
  mkdir -p "$folder/corpus" "$folder/found"
  local seeds
  mapfile -t seeds <"$build/tests/fuzz_$name.seeds"
  # A finding of an earlier run must be gone.
  if ! "$build/tests/fuzz_$name" -max_total_time="$seconds" -print_final_stats=1 -timeout=120 \
    -rss_limit_mb=3000 -max_len=16384 -verbosity=1 -artifact_prefix="$folder/found/" \
    "$folder/corpus" "${seeds[@]}" "$folder/found" >"$folder/log" 2>&1; then
    echo "$name: FOUND, see $folder/log"
    grep -m 3 -E 'ERROR|SUMMARY|runtime error|broken:|terminate' "$folder/log" || true
    return 1
  fi
  awk -v name="$name" '/stat::number_of_executed_units/ {print name ": " $2 " executions"}' "$folder/log"
}
export -f fuzz_one
export build seconds
printf '%s\n' "${targets[@]}" | xargs -P "${JOBS:-$(nproc)}" -I{} bash -c 'fuzz_one {}' |
  mawk -W interactive '{print; if (/ executions$/) sum += $2} END {print "in all: " sum " executions"}'
