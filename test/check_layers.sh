#!/usr/bin/env bash
# Fails when a layer includes what it must not know: core knows no ROS and no devices, device no ROS.
set -euo pipefail
cd "${1:-$(dirname "$0")/..}"

ros='ros/|rosbag/|nodelet/|pluginlib/|tf2|image_transport/|cv_bridge/|actionlib|dynamic_reconfigure/|diagnostic_|message_filters/|[a-z_]+_msgs/|std_srvs/|omnister/ros/|omnister/[A-Z][A-Za-z]*\.h'
devices='arv|boost/asio|libserialport|linux/videodev2|libv4l|termios|omnister/device/'

status=0
check() {
  local banned=$1
  shift
  local folder
  for folder in "$@"; do
    [ -d "$folder" ] || continue
    if grep -rnE "#[[:space:]]*include[[:space:]]*[<\"]($banned)" "$folder"; then
      echo "error: $folder reaches for a higher layer" >&2
      status=1
    fi
  done
}

for layer in common lens calibration stereo view health; do
  check "$ros|$devices" "include/omnister/$layer" "src/$layer"
done
for layer in device sim; do
  check "$ros" "include/omnister/$layer" "src/$layer"
done
exit $status
