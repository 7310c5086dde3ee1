#!/usr/bin/python3
# SPDX-License-Identifier: Apache-2.0
"""Clouds as other programs read them: PCL and Open3D, where they are installed, must see in our PLY and PCD
what a plain reading of the formats sees. Usage: interop_test.py SOURCE BUILD [PROGRAM THAT READS WITH PCL]"""
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

TOLERANCE = 1e-4  # of means, which are summed in other orders


def plain_ply(path):
    """Means as the header of the file promises them."""
    header, body = path.read_bytes().split(b'end_header\n', 1)
    lines = header.decode().splitlines()
    assert 'format binary_little_endian 1.0' in lines, lines
    kinds = {'float': '<f4', 'uchar': 'u1'}
    fields = [(line.split()[2], kinds[line.split()[1]]) for line in lines if line.startswith('property')]
    count = int([line for line in lines if line.startswith('element vertex')][0].split()[2])
    points = np.frombuffer(body, dtype=fields, count=count)
    assert len(body) == count * points.dtype.itemsize
    valid = np.isfinite(points['x'])
    means = [points[valid][name].astype(float).mean() for name in ('x', 'y', 'z', 'red')]
    return count, int(valid.sum()), means


def compare(what, seen, expected):
    assert seen[0] in (expected[0], expected[1]), '%s: %d points, expected %d' % (what, seen[0], expected[0])
    assert seen[1] == expected[1], '%s: %d valid points, expected %d' % (what, seen[1], expected[1])
    for name, a, b in zip(('x', 'y', 'z', 'red'), seen[2], expected[2]):
        assert abs(a - b) <= TOLERANCE * max(1.0, abs(b)), '%s: mean %s is %g, expected %g' % (what, name, a, b)
    print('ok: ' + what)


def main():
    source, build = Path(sys.argv[1]).resolve(), Path(sys.argv[2]).resolve()
    pcl = sys.argv[3] if len(sys.argv) > 3 and os.path.exists(sys.argv[3]) else None
    try:
        import open3d
    except ImportError:
        open3d = None
    if pcl is None and open3d is None:
        print('left out: neither PCL (libpcl-dev) nor Open3D (python3-open3d) is installed')
        return 77
    omnister = str(build / 'devel/lib/omnister/omnister')
    lens, scene = str(source / 'config/demo/lens.yaml'), str(source / 'config/scenes/room.yaml')
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)

        def run(*arguments):
            subprocess.run([omnister, *arguments], cwd=folder, check=True, stdout=subprocess.DEVNULL)

        for image, x in (('0.png', 0.0), ('1.png', 0.2)):
            run('render', '--lens', lens, '--scene', scene, '--pose', '%g 0 0 0 0 0 1' % x, '--out', image)
        for cloud in ('cloud.ply', 'cloud.pcd'):
            run('stereo', '--lens', lens, '--reference', '0.png', '--displaced', '1.png', '--pose',
                '0.2 0 0 0 0 0 1', '--max-range', '12', '--threads', '1', '--cloud', cloud)
        expected = plain_ply(folder / 'cloud.ply')
        assert expected[1] > 100000, expected
        if pcl:
            lines = subprocess.run([pcl, 'cloud.ply', 'cloud.pcd'], cwd=folder, check=True,
                                   stdout=subprocess.PIPE).stdout.decode().splitlines()
            for cloud, line in zip(('PLY', 'PCD'), [line for line in lines if line[:1].isdigit()]):
                words = line.split()
                compare('PCL reads our ' + cloud,
                        (int(words[0]), int(words[1]), [float(word) for word in words[2:6]]), expected)
                assert all(field in words[6].split(',') for field in ('sigma', 'score')), words[6]
        else:
            print('left out: PCL (libpcl-dev) was not there when this was built')
        if open3d:
            for cloud in ('cloud.ply', 'cloud.pcd'):
                read = open3d.io.read_point_cloud(str(folder / cloud), remove_nan_points=True)
                points, colours = np.asarray(read.points), np.asarray(read.colors)
                compare('Open3D reads our ' + cloud[-3:].upper(),
                        (len(points), len(points), [*points.mean(axis=0), 255.0 * colours[:, 0].mean()]), expected)
        else:
            print('left out: Open3D (python3-open3d) is not installed')
    return 0


if __name__ == '__main__':
    sys.exit(main())
