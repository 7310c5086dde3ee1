#!/usr/bin/python3
# SPDX-License-Identifier: Apache-2.0
"""Turns planesweep_car_fisheye (a camera on a car, with poses) into what the `omnister` command takes.

Writes into --out:
  camchain.yaml  the Mei calibration as Kalibr's omni + radtan, for `omnister import --format kalibr`
  pairs.csv      reference image, displaced image, and T_ref_disp as "tx ty tz qx qy qz qw" [m]

    ./run exec python3 test/data_tools/planesweep_car_fisheye.py FOLDER/left --out DIR
    ./run exec omnister import DIR/camchain.yaml --format kalibr --out DIR/left.yaml
    ./run exec omnister stereo --lens DIR/left.yaml --reference ... --displaced ... --pose "..." ...
"""
import argparse
import csv
import os
import struct
import sys

import numpy as np


def rotation(yaw, pitch, roll):
    """Rz(yaw) Ry(pitch) Rx(roll) [rad]."""
    cz, sz, cy, sy, cx, sx = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch), np.cos(roll), np.sin(roll)
    return (
        np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
        @ np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
        @ np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    )


def quaternion(R):
    """(x, y, z, w) of a rotation; the branch keeps the divisor large."""
    trace = np.trace(R)
    if trace > 0:
        s = 2 * np.sqrt(1 + trace)
        q = [(R[2, 1] - R[1, 2]) / s, (R[0, 2] - R[2, 0]) / s, (R[1, 0] - R[0, 1]) / s, s / 4]
    else:
        i = int(np.argmax(np.diag(R)))
        j, k = (i + 1) % 3, (i + 2) % 3
        s = 2 * np.sqrt(1 + R[i, i] - R[j, j] - R[k, k])
        q = [0, 0, 0, (R[k, j] - R[j, k]) / s]
        q[i], q[j], q[k] = s / 4, (R[j, i] + R[i, j]) / s, (R[k, i] + R[i, k]) / s
    q = np.array(q)
    return q / np.linalg.norm(q)


def png_size(path):
    with open(path, "rb") as file:
        head = file.read(24)
    if head[:8] != b"\x89PNG\r\n\x1a\n":
        sys.exit(f"{path} is not a PNG")
    return struct.unpack(">II", head[16:24])


def read_calibration(path):
    with open(path) as file:
        lines = [line.split() for line in file if line.strip()]
    fx, skew, cx, fy, cy, xi, k1, k2, p1, p2 = map(float, lines[0])
    if abs(skew) > 1e-9 * fx:
        sys.exit(f"{path} has skew, which Kalibr's omni model has not")
    T_vehicle_camera = np.eye(4)
    T_vehicle_camera[:3] = [list(map(float, line)) for line in lines[1:4]]
    u, _, vt = np.linalg.svd(T_vehicle_camera[:3, :3])
    T_vehicle_camera[:3, :3] = u @ vt
    return [xi, fx, fy, cx, cy], [k1, k2, p1, p2], T_vehicle_camera


def read_poses(path, T_vehicle_camera):
    """Time to T_world_camera."""
    poses = {}
    with open(path) as file:
        for line in file:
            fields = line.split()
            if line.startswith("#") or len(fields) < 7:
                continue
            T_world_vehicle = np.eye(4)
            T_world_vehicle[:3, :3] = rotation(*map(float, fields[1:4]))
            T_world_vehicle[:3, 3] = list(map(float, fields[4:7]))
            poses[fields[0]] = T_world_vehicle @ T_vehicle_camera
    return poses


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", help="folder `left` or `right` of the data set")
    parser.add_argument("--out", required=True, help="folder to write to")
    parser.add_argument("--step", type=int, default=1, help="pair each frame with the one so many later")
    arguments = parser.parse_args()
    os.makedirs(arguments.out, exist_ok=True)

    intrinsics, distortion, T_vehicle_camera = read_calibration(os.path.join(arguments.folder, "calib.txt"))
    poses = read_poses(os.path.join(arguments.folder, "system_poses.txt"), T_vehicle_camera)
    frames = []
    for name in sorted(os.listdir(arguments.folder)):
        stem, extension = os.path.splitext(name)
        time = stem.split("_")[-1]
        if extension == ".png" and time in poses:
            frames.append((os.path.abspath(os.path.join(arguments.folder, name)), poses[time]))
    if len(frames) <= arguments.step:
        sys.exit(f"no pairs of frames with poses in {arguments.folder}")

    width, height = png_size(frames[0][0])
    with open(os.path.join(arguments.out, "camchain.yaml"), "w") as file:
        file.write("cam0:\n  camera_model: omni\n")
        file.write(f"  intrinsics: [{', '.join(map(repr, intrinsics))}]\n")
        file.write("  distortion_model: radtan\n")
        file.write(f"  distortion_coeffs: [{', '.join(map(repr, distortion))}]\n")
        file.write(f"  resolution: [{width}, {height}]\n")
    with open(os.path.join(arguments.out, "pairs.csv"), "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["reference", "displaced", "T_ref_disp"])
        for (reference, T_world_ref), (displaced, T_world_disp) in zip(frames, frames[arguments.step :]):
            T = np.linalg.inv(T_world_ref) @ T_world_disp
            numbers = list(T[:3, 3]) + list(quaternion(T[:3, :3]))
            writer.writerow([reference, displaced, " ".join(repr(float(x)) for x in numbers)])


if __name__ == "__main__":
    main()
