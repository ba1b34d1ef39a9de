#!/bin/busybox sh
# First process of the guest, from the initramfs: puts a root together that can be written to, and starts systemd on it.
# Below lies the host's own root, read-only; above it what the guest has beyond the host; on top memory, so that
# nothing that is written outlives the guest. Where another root is given, that lies below, and of the layer it gets no
# more than the kernel's modules and what runs the command: it stays what it is.
give_up() {
    echo "rig: $1"
    poweroff -f
}

/bin/busybox --install -s /bin
mount -t proc proc /proc
mount -t devtmpfs devtmpfs /dev
echo "rig: the guest is alive" >/dev/ttyS0
for module in /modules/*; do
    insmod "$module" || give_up "$module cannot be loaded"
done
shared=trans=virtio,version=9p2000.L,msize=512000
mount -t 9p -o "$shared,ro,cache=loose" host /host || give_up "the host's root cannot be mounted"
mount -t 9p -o "$shared,ro,cache=loose" layer /layer || give_up "the guest's layer cannot be mounted"
mount -t tmpfs -o mode=755,size=75% tmpfs /memory || give_up "no memory to write to"
mkdir /memory/upper /memory/work
other=$(grep -o -w rig.root=other /proc/cmdline)
lower=/layer:/host
if [ "$other" ]; then
    mkdir /other
    mount -t 9p -o "$shared,ro,cache=loose" root /other || give_up "the root that was given cannot be mounted"
    lower=/other
fi
mount -t overlay -o lowerdir=$lower,upperdir=/memory/upper,workdir=/memory/work overlay /new ||
    give_up "the root cannot be put together"
if [ "$other" ]; then
    mkdir -p /new/host /new/usr/lib/modules /new/usr/lib/rig /new/etc/systemd/system
    mount -o bind /host /new/host
    for folder in modules rig; do
        mount -o bind /layer/usr/lib/$folder /new/usr/lib/$folder
    done
    cp /layer/etc/systemd/system/rig.* /new/etc/systemd/system
fi
mkdir /new/rig
mount -t 9p -o "$shared,rw,cache=none" exchange /new/rig || give_up "the folder of this run cannot be mounted"
rm -f /new/.dockerenv # it would make systemd believe that it runs in a container, and ignore the command line and udev
: >/new/etc/fstab     # the host's disks are not there
mount -o move /dev /new/dev
umount /proc
exec switch_root /new /lib/systemd/systemd
