#!/usr/bin/env bash
# Fails when the source breaks what README, Security, promises and a reader can see: programs that are started, launch
# files that open the machine, messages that name devices or files.
set -euo pipefail
cd "${1:-$(dirname "$0")/..}"

# What is moved must not leave the checks with nothing to read.
for folder in src include scripts launch msg srv action cfg; do
  [ -n "$(find "$folder" -type f 2>/dev/null)" ] || { echo "error: no file to check in $folder" >&2; exit 1; }
done

status=0
# refuse WHAT MATCHES: any line of MATCHES is a finding.
refuse() {
  [ -z "$2" ] || { echo "error: $1"$'\n'"$2" >&2; status=1; }
}
# but PATTERN: of the lines read, those that do not match; none is no failure.
but() { grep -vE "$1" || true; }

# The command line becomes doctor_node, by its path beside itself, with the words it was given.
refuse "starts a program or a shell" "$(grep -rnE \
  '\b(system|popen|fork|vfork|posix_spawnp?|exec[lv]p?e?|dlopen)[[:space:]]*\(|boost[:/]+process|\bsh[" ]+-c' src include |
  but '^src/tools/cli/doctor_command\.cpp:[0-9]+: *::execv\(doctor\.c_str\(\), argv\.data\(\)\);$|(Bundle|Pose)System system\(')"
refuse "the demo starts a program by a shell" "$(grep -nE 'shell *= *True|os\.(system|popen)' -r scripts || true)"

# What else is read or written by a name goes through file_io.h, contained_path.h or a device.
refuse "a file is opened beside file_io.h" "$(grep -rnE 'std::ofstream|\bfopen[[:space:]]*\(|cv::imwrite|cv::FileStorage' src include |
  but '^src/tools/stereo/stereo_command\.cpp:[0-9]+: *std::ofstream\("/proc/self/clear_refs"\)')"
refuse "executables or folders for everybody" "$(grep -rnE '\bchmod[[:space:]]*\(|\b0777\b|perms::all' src include || true)"

for launch in launch/*.launch; do
  # rviz alone serves nobody.
  [ "$launch" = launch/rviz.launch ] && continue
  grep -q 'name="ROS_HOSTNAME" value="localhost"' "$launch" || refuse "not on loopback by default" "$launch"
done

# A scan names a new folder inside the node's own (contained_path.h); results say where something was written. A lens
# travels as text, never as a path.
refuse "a message names a device or a file" "$(for file in msg/*.msg srv/*.srv action/*.action; do
  awk -v file="$file" '/^---/ {part++} part == 0 {print file ": " $0}' "$file"
done | grep -E 'string(\[\])? +\w*(device|port|path|file|folder|dir|url|feature|register|command)' |
  but '^action/Scan\.action: string folder ')"
# `mask` is read as an image: a regular file of bounded size, or refused.
refuse "a live parameter names a device or a file" "$(grep -nE "gen\.add\('(\w*(device|port|path|file|folder|url|features?|register|mask)\w*)', *str_t" cfg/*.cfg |
  but "^cfg/Stereo\.cfg:[0-9]+:gen\.add\('mask'")"
# Writing registers by name is a parameter, and off.
grep -q 'source.texts("features")' src/ros/camera/camera_driver.cpp || refuse "features comes from elsewhere" src/ros/camera/camera_driver.cpp
refuse "features are written by default" "$(grep -nE '"features"' launch/*.launch | but 'value="\$\(arg features\)"')"

grep -q '^### Security' README.md || refuse "no paragraph on exposing ROS 1 safely" README.md
exit $status
