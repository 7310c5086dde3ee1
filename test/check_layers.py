#!/usr/bin/python3
# SPDX-License-Identifier: Apache-2.0
"""Holds the includes of src/ and include/ to src/layers.txt: no room uses a room that is not listed above it and named in
its line. Also fails for a folder or a header that the table does not have, for a line of the table that belongs to
nothing, and for more than 14 files in one folder of src/. Usage: check_layers.py SOURCE, or check_layers.py --self-test
SOURCE, which plants faults in a copy and sees that each is found."""
import re
import shutil
import sys
import tempfile
from pathlib import Path

MOST_FILES = 14
INCLUDE = re.compile(r'^[ \t]*#[ \t]*include[ \t]*([<"])([^>"]+)[>"]', re.M)


class Table:
    def __init__(self, path):
        self.rooms, self.headers, self.foreign, self.problems = {}, {}, [], []
        for number, line in enumerate(path.read_text().splitlines(), 1):
            line = line.strip()
            if not line or line.startswith('#'):
                continue
            if ' -> ' in line:
                header, room = line.split(' -> ')
                self.headers['omnister/' + header] = room
            elif line.count(' = ') == 2:
                name, layers, pattern = line.split(' = ')
                self.foreign.append((name, layers.split(), re.compile(pattern)))
            elif ':' in line:
                room, used = line.split(':', 1)
                for other in used.split():
                    if other not in self.rooms:
                        self.problems.append('%s:%d: %s uses %s, which is not listed above it' %
                                             (path.name, number, room, other))
                if room in self.rooms:
                    self.problems.append('%s:%d: %s is listed twice' % (path.name, number, room))
                self.rooms[room] = set(used.split())
            else:
                self.problems.append('%s:%d: cannot read this line' % (path.name, number))
        self.problems += ['%s: %s belongs to %s, which is no room' % (path.name, header, room)
                          for header, room in self.headers.items() if room not in self.rooms]


def rooms_of_files(source, table, problems):
    """Room of every file, by the path that an include line names it by."""
    by_include, files = {}, {}
    for path in sorted((source / 'src').rglob('*')):
        if path.suffix in ('.cpp', '.h'):
            name = str(path.relative_to(source / 'src'))
            by_include[name] = files[path] = str(Path(name).parent)
    by_stem = {}
    for path, room in files.items():
        if path.suffix == '.cpp':
            by_stem.setdefault((room.split('/')[0], path.stem), set()).add(room)
    for path in sorted((source / 'include/omnister').rglob('*.h')):
        name = str(path.relative_to(source / 'include'))
        found = by_stem.get((path.parent.name, path.stem), set())
        if name in table.headers:
            found = {table.headers[name]}
        if len(found) != 1:
            problems.append('%s: layers.txt does not say which room it belongs to' % name)
            continue
        by_include[name] = files[path] = found.pop()
    problems += ['layers.txt: there is no header %s' % name for name in table.headers if name not in by_include]
    return by_include, files


def check(source):
    """Lines that say what is wrong."""
    table = Table(source / 'src/layers.txt')
    problems = list(table.problems)
    by_include, files = rooms_of_files(source, table, problems)
    if len(files) < 100:
        problems.append('only %d files were found in src and include: does this test still read them?' % len(files))
    used_rooms = set(files.values())
    problems += ['src/%s: this folder is not in layers.txt' % room for room in sorted(used_rooms - set(table.rooms))]
    problems += ['layers.txt: room %s has no file' % room for room in sorted(set(table.rooms) - used_rooms)]
    for path, room in files.items():
        name = path.relative_to(source)
        for bracket, header in INCLUDE.findall(path.read_text()):
            other = by_include.get(header)
            if other is None:
                for kind, layers, pattern in table.foreign:
                    if pattern.match(header) and room.split('/')[0] not in layers:
                        problems.append('%s includes %s: %s is for %s only' % (name, header, kind, ' and '.join(layers)))
                if bracket == '"' and not header.startswith('omnister/'):
                    problems.append('%s includes "%s", which is no path below src or include' % (name, header))
            elif other != room and other not in table.rooms.get(room, ()):
                problems.append('%s includes %s: room %s does not use %s' % (name, header, room, other))
    for folder in [path for path in (source / 'src').rglob('*') if path.is_dir()]:
        count = sum(path.is_file() for path in folder.iterdir())
        if count > MOST_FILES:
            problems.append('%s has %d files, at most %d' % (folder.relative_to(source), count, MOST_FILES))
    return problems


def self_test(source):
    """@return what was planted and not found"""
    def include(file, line):
        return lambda root: (root / file).write_text(line + '\n' + (root / file).read_text())

    def replace(old, new):
        table = 'src/layers.txt'
        return lambda root: (root / table).write_text((root / table).read_text().replace(old, new))

    def crowd(root):
        for number in range(MOST_FILES + 1):
            (root / 'src/view' / ('more_%d.cpp' % number)).write_text('')

    def folder(root):
        (root / 'src/view/attic').mkdir()
        (root / 'src/view/attic/old.cpp').write_text('')

    def empty(root):
        shutil.rmtree(root / 'src')
        (root / 'src').mkdir()
        shutil.copy(source / 'src/layers.txt', root / 'src')

    faults = {
        'core includes ROS': (include('src/lens/model/lens_models.cpp', '#include <ros/ros.h>'), 'ROS is for ros only'),
        'core includes a message': (include('include/omnister/view/view.h', '#  include <sensor_msgs/Image.h>'), 'ROS'),
        'core includes a device': (include('src/stereo/result/cloud.cpp', '#include <termios.h>'), 'devices is for'),
        'device includes a node': (include('src/device/open_stage.cpp', '#include "ros/node/parameters.h"'),
                                   'device does not use ros/node'),
        'a lower layer of core includes a higher one': (include('src/lens/file/lens_file.cpp',
                                                                '#include "omnister/stereo/cloud.h"'),
                                                        'lens/file does not use stereo/result'),
        'a lower room includes a higher one': (include('src/calibration/fit/fit.cpp',
                                                       '#include "omnister/calibration/calibrate.h"'),
                                               'calibration/fit does not use calibration/board'),
        'the product includes the simulator': (include('src/ros/stage/stage_driver.cpp',
                                                       '#include "omnister/sim/simulated_stage.h"'),
                                               'ros/stage does not use sim/stage'),
        'an include by a path of its own': (include('src/view/view.cpp', '#include "neighbor.h"'), 'no path below'),
        'the table lets a room use a higher one': (replace('lens/model: common', 'lens/model: common view'),
                                                   'which is not listed above'),
        'the table has a room without files': (replace('lens/model: common', 'lens/model: common\nlens/gone: common'),
                                               'has no file'),
        'a folder that is not in the table': (folder, 'not in layers.txt'),
        'a crowded folder': (crowd, 'at most 14'),
        'no files': (empty, 'does this test still read them'),
    }
    failures = []
    for name, (plant, expected) in faults.items():
        with tempfile.TemporaryDirectory() as temporary:
            root = Path(temporary)
            for part in ('src', 'include'):
                shutil.copytree(source / part, root / part)
            plant(root)
            found = [line for line in check(root) if expected in line]
            if not found:
                failures.append('not found: %s' % name)
    print('%d kinds of faults planted' % len(faults))
    return failures


def main():
    source = Path(sys.argv[-1])
    problems = self_test(source) if '--self-test' in sys.argv else check(source)
    for line in problems:
        print('error: ' + line)
    return 1 if problems else 0


if __name__ == '__main__':
    sys.exit(main())
