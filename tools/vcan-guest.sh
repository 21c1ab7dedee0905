#!/bin/bash
# First process of the guest that tools/with-vcan.sh starts; of no use by itself.
#
# The root file system is the host's, read only. VCAN_GUEST names the folder with what to do:
# settings, environment and command; the command's exit status is left there in the file `status`.
exec </dev/null >/dev/tty0 2>&1
PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
shared='' limit='' cache=''
# shellcheck source=/dev/null
. "$VCAN_GUEST/settings"

power_off() {
    sync
    echo o >/proc/sysrq-trigger
    sleep 30
}
trap power_off EXIT # the end of the first process would be a panic

mount -t proc proc /proc
mount -t sysfs sysfs /sys
while read -r module; do insmod "$cache/$module"; done <"$cache/modules"

# The host's files under a layer that takes all writes and is thrown away with the guest.
mount -t tmpfs tmpfs /mnt && mkdir /mnt/above /mnt/work /mnt/root &&
    mount -t overlay -o lowerdir=/,upperdir=/mnt/above,workdir=/mnt/work overlay /mnt/root || exit
root=/mnt/root
for folder in "$shared" "$VCAN_GUEST"; do
    mount -t hostfs -o "$folder" none "$root$folder" || exit
done
mount -t proc proc $root/proc
mount -t sysfs sysfs $root/sys
mount -t devtmpfs devtmpfs $root/dev
mkdir -p $root/dev/pts $root/dev/shm
mount -t devpts -o ptmxmode=666 devpts $root/dev/pts
mount -t tmpfs -o mode=1777 tmpfs $root/dev/shm
mount -t tmpfs -o mode=755 tmpfs $root/run
ln -sfn /proc/self/fd $root/dev/fd
for number in 0:stdin 1:stdout 2:stderr; do
    ln -sfn "/proc/self/fd/${number%:*}" "$root/dev/${number#*:}"
done

ip link set lo up
for name in vcan0 vcan1; do
    ip link add "$name" type vcan && ip link set "$name" mtu 72 up || exit
done
# A reader that waits for the one processor must not lose frames to a small buffer.
for kind in max default; do echo 16777216 >/proc/sys/net/core/rmem_$kind; done

# Forget files now and then: each that is remembered costs the host a descriptor.
(while sleep 1; do
    read -r remembered _ </proc/sys/fs/inode-nr
    [ "$remembered" -lt 200000 ] || echo 2 >/proc/sys/vm/drop_caches
done) &

# Through pipes, so that the command does not take the consoles for terminals.
for console in 1 2; do stty --file=/dev/tty$console raw -echo; done
mkfifo /mnt/out /mnt/err
cat /mnt/out >/dev/tty1 &
out=$!
cat /mnt/err >/dev/tty2 &
err=$!
(
    # shellcheck source=/dev/null
    . "$VCAN_GUEST/environment"
    exec chroot $root timeout --kill-after=10 "$limit" /bin/bash "$VCAN_GUEST/command"
) >/mnt/out 2>/mnt/err
status=$?
for _ in $(seq 50); do # a child left behind may hold the pipes open
    kill -0 $out 2>/dev/null || kill -0 $err 2>/dev/null || break
    sleep 0.1
done
echo $status >"$root$VCAN_GUEST/status"
