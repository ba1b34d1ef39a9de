# The guest's only job: runs the command that the host has left in /rig, tells its status, and ends the guest.
stty -F /dev/hvc0 raw -echo
exec 2>/dev/hvc0
give_up() {
    echo "rig: $1" >&2
    echo 125 >/rig/status.part
    mv /rig/status.part /rig/status
    systemctl poweroff --force --force
    exit
}
cut -d' ' -f1 /proc/uptime >/rig/boot_s
ip link set lo up
if [ -e /rig/in_memory.tar ]; then # into an empty folder, and in large pieces: what is looked up or read is asked of the host
    mkdir /run/in_memory
    mount -t tmpfs -o size=60% tmpfs /run/in_memory || give_up "no memory for --in-memory"
    tar -x -b 900 -f /rig/in_memory.tar -C /run/in_memory || give_up "--in-memory: unpacking failed; try a larger --memory"
    while read -r folder; do
        mount --bind "/run/in_memory$folder" "$folder" || give_up "$folder cannot be put over the host's"
    done </rig/in_memory
fi
modprobe -a can_raw can_dev vcan kvaser_pci || echo "rig: a CAN module cannot be loaded" >&2
bash /rig/command </dev/null >/dev/hvc0 2>&1
echo $? >/rig/status.part
mv /rig/status.part /rig/status
systemctl poweroff --force --force
