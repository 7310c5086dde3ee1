#!/usr/bin/python3
# SPDX-License-Identifier: Apache-2.0
"""Runs the command blocks of the documents as they are printed. Usage: readme_test.py SOURCE BUILD

Behind every ```sh block stands how it is run:
    <!-- run: always -->                in every test
    <!-- run: full -->                  with OMNISTER_FULL_TESTS=ON; else it is said to be left out
    <!-- run: full, needs board -->     likewise; images of a board are rendered before
    <!-- run: never, REASON -->
A block without it fails, and so does a link to a file that is not there. ROS is not needed by any of them
but what ./run itself needs."""
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

DOCUMENTS = ['README.md'] + ['docs/%s.md' % name for name in
                             ('tour', 'rig', 'choosing', 'architecture', 'extending', 'faults', 'nodes', 'lens_models')]
BLOCK = re.compile(r'^( *)```sh\n(.*?)^\1```\n(?:\1<!-- run: (.*?) -->\n)?', re.M | re.S)
LINK = re.compile(r'\]\(([^)#:]+)\)')
# Poses of the camera before the board of config/scenes/calibration_board.yaml: x y z [m], half the turns [rad].
BOARD_POSES = [(x, y, -z, rx, ry) for z in (0.45, 0.6) for x, y, rx, ry in
               ((0.0, 0.0, 0.0, 0.35), (0.12, 0.0, 0.0, -0.4), (-0.12, 0.02, 0.35, 0.0), (0.0, 0.1, -0.35, 0.0),
                (0.1, -0.1, 0.25, 0.3), (-0.1, 0.1, -0.25, -0.3))]


def shell(text, folder, environment):
    done = subprocess.run(['bash', '-euo', 'pipefail', '-c', text], cwd=folder, env=environment,
                          stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    return done.returncode, done.stdout.decode('utf-8', 'replace')


def render_board(folder, environment):
    (folder / 'board').mkdir(exist_ok=True)
    (folder / 'board.yaml').write_text('{type: checkerboard, cols: 9, rows: 6, square_m: 0.06}\n')
    lines = []
    for number, (x, y, z, rx, ry) in enumerate(BOARD_POSES):
        lines.append('./run exec omnister render --lens config/demo/lens.yaml --scene config/scenes/calibration_board.yaml '
                     '--pose "%g %g %g %g %g 0 1" --out board/%d.png' % (x, y, z, rx / 2, ry / 2, number))
    code, output = shell('\n'.join(lines), folder, environment)
    if code != 0:
        raise SystemExit('rendering the board failed:\n' + output)


def main():
    source, build = Path(sys.argv[1]).resolve(), Path(sys.argv[2]).resolve()
    full = os.environ.get('OMNISTER_FULL_TESTS') == 'ON'
    failures, ran, left_out = [], 0, []
    environment = dict(os.environ, OMNISTER_BUILD_DIR=str(build))
    for document in DOCUMENTS:
        text = (source / document).read_text()
        for link in LINK.findall(text):
            if not ((source / document).parent / link).exists():
                failures.append('%s: the link to %s leads nowhere' % (document, link))
        if text.count('```sh') != len(BLOCK.findall(text)):
            failures.append('%s: a block of commands has no end' % document)
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            (folder / 'config').symlink_to(source / 'config')
            run = folder / 'run'
            run.write_text('#!/bin/sh\nexec "%s/run" "$@"\n' % source)
            run.chmod(0o755)
            for _, block, how in BLOCK.findall(text):
                title = '%s: %s' % (document, block.strip().splitlines()[0])
                if not re.match(r'(always|full|never, .+)', how):
                    failures.append(title + ': the block is not marked with how to run it')
                elif how.startswith('never') or (how.startswith('full') and not full):
                    left_out.append('%s (%s)' % (title, how))
                else:
                    if 'needs board' in how:
                        render_board(folder, environment)
                    code, output = shell(block, folder, environment)
                    ran += 1
                    print('%s: %s' % ('ok' if code == 0 else 'FAILED', title), flush=True)
                    if code != 0:
                        failures.append('%s: exit code %d\n%s' % (title, code, output))
    for title in left_out:
        print('left out: ' + title)
    if ran == 0:
        failures.append('no block was run at all')
    print('\n'.join(failures))
    return 1 if failures else 0


if __name__ == '__main__':
    sys.exit(main())
