#!/usr/bin/env bash
# run.sh BUILD SECONDS [TARGET…]: every fuzz target for SECONDS, on all cores in turn (or JOBS of them); the
# corpus grows in BUILD/fuzz. Prints executions, inputs kept and findings by target, executions in all, and
# those of all runs so far, whose record is OMNISTER_FUZZ_RECORD (BUILD/fuzz/record.csv). Fails when one of them
# found something, which lies beside the corpus then.
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
export ASAN_OPTIONS=allocator_may_return_null=1
export UBSAN_OPTIONS=print_stacktrace=1
mkdir -p "$build/fuzz"
record=${OMNISTER_FUZZ_RECORD:-$build/fuzz/record.csv}
[ -s "$record" ] || echo "end,target,seconds,executions,corpus,findings" >"$record"

fuzz_one() {
  local name=$1 folder=$build/fuzz/$1 status=0 begin=$SECONDS
  mkdir -p "$folder/corpus" "$folder/found"
  local seeds
  mapfile -t seeds <"$build/tests/fuzz_$name.seeds"
  # A finding of an earlier run must be gone.
  "$build/tests/fuzz_$name" -max_total_time="$seconds" -print_final_stats=1 -timeout=120 \
    -rss_limit_mb=3000 -max_len=16384 -verbosity=1 -artifact_prefix="$folder/found/" \
    "$folder/corpus" "${seeds[@]}" "$folder/found" >"$folder/log" 2>&1 || status=1
  # After a finding there is no summary: the last line that told of progress stands for it.
  local executions corpus
  executions=$(awk '/^#[0-9]+/ {last = substr($1, 2)} /stat::number_of_executed_units/ {last = $2}
    END {print last + 0}' "$folder/log")
  corpus=$(find "$folder/corpus" -type f | wc -l)
  echo "$name: $executions executions, $corpus inputs kept, $status findings"
  echo "$(date -u +%FT%TZ),$name,$((SECONDS - begin)),$executions,$corpus,$status" >>"$record"
  [ "$status" = 0 ] && return
  echo "$name: FOUND, see $folder/log"
  grep -m 3 -E 'ERROR|SUMMARY|runtime error|broken:|terminate' "$folder/log" || true
  return 1
}
export -f fuzz_one
export build seconds record
failed=0
printf '%s\n' "${targets[@]}" | xargs -P "${JOBS:-$(nproc)}" -I{} bash -c 'fuzz_one {}' |
  mawk -W interactive '{print} / executions, / {sum += $2} END {print "in all: " sum + 0 " executions"}' || failed=1
awk -F, 'NR > 1 {sum += $4; found += $6} END {printf "all runs so far: %.2f million executions, %d findings\n",
  sum / 1e6, found}' "$record"
exit "$failed"
