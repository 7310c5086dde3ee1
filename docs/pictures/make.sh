#!/usr/bin/env bash
# Makes the pictures of the documents anew: ./run exec docs/pictures/make.sh
# Nothing but the package's own simulated rig and room stands in them.
set -euo pipefail
out=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd -P)
work=$(mktemp -d)
pids=()
finish() {
  for pid in "${pids[@]}"; do kill -INT "$pid" 2>/dev/null || true; done
  wait
  rm -rf "$work"
}
trap finish EXIT

export ROS_HOME=$work/ros ROS_LOG_DIR=$work/log QT_QPA_PLATFORM=xcb LIBGL_ALWAYS_SOFTWARE=1
export XDG_RUNTIME_DIR=$work/runtime
mkdir -m 700 "$XDG_RUNTIME_DIR"
port=$(/usr/bin/python3 -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])')
export ROS_MASTER_URI=http://localhost:$port
Xvfb -displayfd 4 -screen 0 1280x1024x24 -nolisten tcp 4>"$work/display" 2>/dev/null &
pids+=($!)
until [ -s "$work/display" ]; do sleep 0.1; done
DISPLAY=:$(cat "$work/display")
export DISPLAY

share=$(rospack find omnister)
# The lens that calibration would find stands in the camera's store.
mkdir "$work/store"
cp "$share/config/demo/lens.yaml" "$work/store/demo-camera.yaml"
cat >"$work/pictures.launch" <<XML
<launch>
  <include file="$share/launch/demo.launch">
    <arg name="gui" value="false"/>
    <arg name="store" value="$work/store"/>
    <arg name="port" value="$work/stage"/>
  </include>
  <include file="$share/launch/rviz.launch"><arg name="handle" value="false"/></include>
</launch>
XML
roslaunch -p "$port" "$work/pictures.launch" >"$work/roslaunch.log" 2>&1 &
pids+=($!)
until rostopic list >/dev/null 2>&1; do
  kill -0 "${pids[-1]}" 2>/dev/null || { tail -n 5 "$work/roslaunch.log" >&2; exit 1; }
  sleep 0.5
done
cat >"$work/take.py" <<'PY'
import sys
import numpy
import rosgraph
import rospy
from omnister.msg import MoveStageActionGoal, MoveStageActionResult, MoveStageGoal, StageState
from sensor_msgs.msg import Image, PointCloud2
from std_srvs.srv import Trigger

rospy.init_node('pictures')
rospy.wait_for_message('/camera/image_raw', Image, 120)
rospy.wait_for_service('/stage/home', 60)
rospy.ServiceProxy('/stage/home', Trigger)()
while not rospy.wait_for_message('/stage/stage_state', StageState, 60).homed:
    pass
goals = rospy.Publisher('/stage/move_stage/goal', MoveStageActionGoal, queue_size=1)
while goals.get_num_connections() == 0:
    rospy.sleep(0.1)
# rviz starts when it can; pairs are made of what was seen while somebody listened.
master = rosgraph.Master('/pictures')
while not any('/rviz_rig' in nodes for topic, nodes in master.getSystemState()[1] if topic == '/camera/points2'):
    rospy.sleep(0.5)
clouds, pictures = [], []
rospy.Subscriber('/camera/points2', PointCloud2, clouds.append, queue_size=1, buff_size=1 << 25)
rospy.Subscriber('/camera/epipolar', Image, pictures.append, queue_size=1, buff_size=1 << 25)
while len(clouds) < 4 or not pictures:
    for position in (0.1, 0.3):
        goals.publish(MoveStageActionGoal(goal=MoveStageGoal(position=position)))
        rospy.wait_for_message('/stage/move_stage/result', MoveStageActionResult, 60)
        rospy.sleep(4.0)
image = pictures[-1]
pixels = numpy.frombuffer(image.data, numpy.uint8).reshape(image.height, image.width, 3)[:, :, ::-1]
with open(sys.argv[1], 'wb') as file:
    file.write(b'P6 %d %d 255\n' % (image.width, image.height) + pixels.tobytes())
rospy.sleep(10.0)  # for rviz to draw
PY
/usr/bin/python3 "$work/take.py" "$work/epipolar.ppm"
import -window root "$work/rviz.png"
small=(-strip -dither FloydSteinberg -colors 96 -define png:compression-level=9)
convert "$work/rviz.png" -crop 900x556+368+66 +repage -resize 720x "${small[@]}" "$out/cloud.png"
convert "$work/epipolar.ppm" -crop 100%x84%+0+60 +repage -resize 900x "${small[@]}" "$out/epipolar.png"
ls -l "$out"/*.png
