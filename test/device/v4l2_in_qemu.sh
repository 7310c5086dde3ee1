#!/usr/bin/env bash
# Runs the V4L2 test where there are cameras: a virtual machine with Debian's own kernel, whose driver
# vivid makes two. Needs no rights and changes nothing: the machine sees the host's files read-only.
#   test/device/v4l2_in_qemu.sh [TEST_PROGRAM [ARGUMENT…]]
# Exit status: that of the test; 77 where something is missing (said on standard error).
set -euo pipefail
export PATH=/usr/sbin:/usr/bin:/sbin:/bin:$PATH
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/../.." && pwd -P)
program=${1:-${OMNISTER_BUILD_DIR:-$root/build}/tests/device_v4l2_camera_test}
[ $# -gt 0 ] && shift
cache=${XDG_CACHE_HOME:-${HOME:-/tmp}/.cache}/omnister/qemu
seconds=${OMNISTER_QEMU_SECONDS:-300}

skip() {
  echo "skipped: $*" >&2
  exit 77
}
[ -x "$program" ] || skip "there is no $program: build the target device_v4l2_camera_test"
packages="qemu-system-x86 seabios ipxe-qemu busybox-static cpio kmod"
for tool in qemu-system-x86_64 busybox cpio depmod modprobe dpkg; do
  command -v "$tool" >/dev/null || skip "$tool is missing: apt-get install --no-install-recommends $packages"
done
busybox=$(command -v busybox)
ldd "$busybox" >/dev/null 2>&1 && skip "busybox is not static: apt-get install busybox-static"

# Debian's kernel, unpacked once.
kernel=$(ls "$cache"/boot/vmlinuz-* 2>/dev/null | sort -V | tail -n 1 || true)
if [ -z "$kernel" ]; then
  mkdir -p "$cache"
  package=$(apt-cache search -n '^linux-image-[0-9.]+-[0-9]+-amd64$' | awk '{print $1}' | sort -V | tail -n 1)
  [ -n "$package" ] || skip "apt knows no linux-image-…-amd64"
  (cd "$cache" && apt-get -q download "$package" >/dev/null 2>&1) || skip "$package cannot be downloaded"
  dpkg -x "$cache/$package"_*.deb "$cache"
  rm -f "$cache/$package"_*.deb
  kernel=$(ls "$cache"/boot/vmlinuz-* | sort -V | tail -n 1)
fi
version=${kernel##*/vmlinuz-}
depmod -b "$cache" "$version"

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
mkdir -p "$work"/image/{bin,dev,proc,sys,host,upper,root,modules}
cp "$busybox" "$work/image/bin/busybox"
order=$work/image/modules/order
: >"$order"
for module in virtio_pci 9pnet_virtio 9p overlay vivid; do
  modprobe -d "$cache" -S "$version" --show-depends "$module" 2>/dev/null |
    awk '$1 == "insmod" {print $2}' | while read -r file; do
    name=$(basename "$file")
    grep -qx "$name" "$order" && continue
    cp "$file" "$work/image/modules/$name"
    echo "$name" >>"$order"
  done
done
grep -q '^vivid' "$order" || skip "the kernel $version has no driver vivid"
printf -v command '%q ' "$program" "$@"
cat >"$work/image/init" <<INIT
#!/bin/busybox sh
/bin/busybox --install -s /bin
export PATH=/bin
mount -t proc proc /proc
mount -t sysfs sys /sys
mount -t devtmpfs dev /dev
for module in \$(cat /modules/order); do
  options=
  case \$module in vivid.*) options="n_devs=2 node_types=0x1,0x1 num_inputs=1,1 input_types=0,0" ;; esac
  insmod /modules/\$module \$options || echo "insmod \$module failed"
done
mount -t 9p -o trans=virtio,version=9p2000.L,ro,cache=loose,msize=262144 host /host
mount -t tmpfs none /upper
mkdir /upper/data /upper/work
mount -t overlay -o lowerdir=/host,upperdir=/upper/data,workdir=/upper/work none /root
mount --move /proc /root/proc
mount --move /sys /root/sys
mount --move /dev /root/dev
mount -t tmpfs none /root/tmp 2>/dev/null
ip link set lo up
chroot /root /usr/bin/env OMNISTER_VIVID=1 LC_ALL=C.UTF-8 HOME=/tmp LD_LIBRARY_PATH="$(printf %s "${LD_LIBRARY_PATH:-}")" \
  /bin/sh -c 'cd $(printf %q "$root"); $command'
echo "OMNISTER_STATUS=\$?"
poweroff -f
INIT
chmod +x "$work/image/init"
(cd "$work/image" && find . | cpio -o -H newc --quiet) | gzip -1 >"$work/initramfs.gz"

timeout "$seconds" qemu-system-x86_64 -machine q35 -cpu max -smp 2 -m 1024 -nographic -no-reboot -nodefaults \
  -serial stdio -kernel "$kernel" -initrd "$work/initramfs.gz" \
  -append "console=ttyS0 quiet loglevel=3 panic=-1 mitigations=off cryptomgr.notests" \
  -fsdev local,id=host,path=/,security_model=none,readonly=on,multidevs=remap \
  -device virtio-9p-pci,fsdev=host,mount_tag=host </dev/null | tee "$work/log" || true
status=$(sed -n 's/.*OMNISTER_STATUS=\([0-9]*\).*/\1/p' "$work/log" | tail -n 1)
[ -n "$status" ] || {
  echo "the virtual machine did not get to the end of the test" >&2
  exit 1
}
exit "$status"
