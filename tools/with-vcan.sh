#!/bin/bash
# tools/with-vcan.sh COMMAND [ARGUMENT...]
#
# Runs COMMAND where vcan0 and vcan1 are real SocketCAN interfaces of a Linux kernel.
#
# Where this machine's kernel has the vcan driver, COMMAND runs natively, in a network namespace of
# its own. Elsewhere it runs in a User-Mode-Linux guest: a Linux kernel that is an ordinary process
# of this machine. The guest sees this machine's files; what it writes stays in the guest, but for
# the current folder, which is shared. It has loopback and the two CAN interfaces, no other network,
# one processor, and an empty standard input. Output and exit status are passed on.
#
# The guest needs root, an amd64 Debian (or a relative of it) and the packages iproute2 and kmod.
# Its kernel is Debian's package user-mode-linux, taken once through this machine's own apt sources
# from a later suite: kernels before 6.16 do not start on processors with large vector registers.
#
# Exit status: that of COMMAND; 124 when it took longer than WITH_VCAN_TIMEOUT; 125 when there is no
# way to give it a vcan interface here (said on standard error).
#
#   WITH_VCAN_TIMEOUT  seconds that COMMAND may take                 (1800)
#   WITH_VCAN_CACHE    folder of the guest's kernel    (~/.cache/ehadiag-vcan)
#   WITH_VCAN_MEMORY   memory of the guest, taken as it is used     (3072M)
#   WITH_VCAN_GUEST    "always": guest also where native would do
set -u

here=$(cd "$(dirname "$0")" && pwd)
cache=${WITH_VCAN_CACHE:-${XDG_CACHE_HOME:-$HOME/.cache}/ehadiag-vcan}
limit=${WITH_VCAN_TIMEOUT:-1800}

give_up() {
    echo "with-vcan: $*" >&2
    exit 125
}

# --- natively -------------------------------------------------------------------------------------

links='ip link set lo up
for name in vcan0 vcan1; do
    ip link add "$name" type vcan && ip link set "$name" mtu 72 up || exit 125
done'

namespace() { # the unshare command that may make CAN interfaces here; fails where none may
    modprobe --quiet vcan 2>/dev/null
    local options
    for options in "--net" "--map-root-user --net"; do
        # shellcheck disable=SC2086 # one word per option
        if unshare $options sh -c "$links" 2>/dev/null; then
            echo "unshare $options"
            return 0
        fi
    done
    return 1
}

# --- the guest's kernel ---------------------------------------------------------------------------

modules="net/can/can net/can/can-raw net/can/can-bcm net/can/can-gw drivers/net/can/dev/can-dev
         drivers/net/can/vcan drivers/net/can/slcan/slcan fs/overlayfs/overlay"

later_suite() { # FOLDER SUITE: apt settings that know this one suite, and leave the machine's alone
    local source
    source=$(apt-get indextargets --format '$(REPO_URI)' 'Created-By: Packages' |
        grep --invert-match security | head --lines=1)
    [ -n "$source" ] || return 1
    mkdir --parents "$1/lists/partial" "$1/archives/partial"
    touch "$1/installed"
    echo "deb [signed-by=/usr/share/keyrings/debian-archive-keyring.gpg] $source $2 main" >"$1/list"
    printf '%s "%s";\n' \
        Dir::Etc::sourcelist "$1/list" Dir::Etc::sourceparts /dev/null \
        Dir::State::lists "$1/lists" Dir::State::status "$1/installed" Dir::Cache "$1" \
        APT::Sandbox::User root Acquire::Languages none Acquire::Retries 3 >"$1/settings"
    APT_CONFIG=$1/settings apt-get --quiet=2 update
}

unpack_kernel() { # FOLDER: kernel, its C library and the modules in use, into $cache
    local parts=$1/new tree kernel module
    mkdir "$parts" "$1/kernel" "$1/library" || return 1
    dpkg-deb --extract "$1"/user-mode-linux_*.deb "$1/kernel" || return 1
    dpkg-deb --extract "$1"/libc6_*.deb "$1/library" || return 1
    cp "$1"/library/usr/lib/x86_64-linux-gnu/{ld-linux-x86-64.so.2,libc.so.6} "$parts" || return 1
    # The kernel wants a later C library than this machine's, by an absolute path. Give it the one
    # beside it: same length, padded with zeros, so that nothing else in the file moves.
    LC_ALL=C sed 's#/lib64/ld-linux-x86-64\.so\.2#./ld-linux-x86-64.so.2\x0\x0\x0\x0\x0#' \
        "$1/kernel/usr/bin/linux.uml" >"$parts/linux" || return 1
    chmod +x "$parts/linux"
    tree=$(echo "$1"/kernel/usr/lib/uml/modules/*/kernel)
    for module in $modules; do
        kernel=$tree/$module.ko
        if [ -e "$kernel" ]; then # otherwise it is built in
            cp "$kernel" "$parts" && basename "$kernel" >>"$parts/modules" || return 1
        fi
    done
    mkdir --parents "$(dirname "$cache")"
    rm -rf "$cache" && cp --recursive "$parts" "$cache"
}

get_kernel() {
    local work suite version status=1
    command -v dpkg-deb >/dev/null && [ "$(dpkg --print-architecture)" = amd64 ] || return 1
    work=$(mktemp --directory) || return 1
    for suite in forky sid; do
        rm -rf "$work/apt" && mkdir "$work/apt" && later_suite "$work/apt" "$suite" || continue
        (cd "$work/apt" && APT_CONFIG=$work/apt/settings \
            apt-get --quiet=2 download user-mode-linux libc6) || continue
        version=$(dpkg-deb --field "$work"/apt/user-mode-linux_*.deb Version)
        dpkg --compare-versions "$version" ge 6.16 || continue
        unpack_kernel "$work/apt" && status=0 && break
    done
    rm -rf "$work"
    return $status
}

# --- in the guest ---------------------------------------------------------------------------------

run_in_guest() {
    local run memory_folder processor guest status
    run=$(mktemp --directory) || give_up "no temporary folder"
    # shellcheck disable=SC2064 # expand now
    trap "rm -rf '$run'" EXIT
    export -p >"$run/environment"
    {
        printf 'cd %q || exit 125\nexec' "$PWD"
        printf ' %q' "$@"
        echo
    } >"$run/command"
    printf '%s=%q\n' shared "$PWD" limit "$limit" cache "$cache" >"$run/settings"

    # The guest holds a descriptor open for each file that it remembers.
    ulimit -n "$(cat /proc/sys/fs/nr_open)" 2>/dev/null || ulimit -n "$(ulimit -Hn)"
    # Its memory is a file, best one that is in memory.
    memory_folder=$run
    [ "$(df --output=avail /dev/shm 2>/dev/null | tail -n 1)" -gt 4000000 ] 2>/dev/null &&
        memory_folder=/dev/shm
    # The guest's kernel and its processes take turns: on one processor that costs the least.
    processor=$(taskset --cpu-list --pid $$ | sed 's/.*[-,: ]//')

    exec 3>&1 4>&2
    cd "$cache" || give_up "no folder $cache"
    # Console 0 shows the boot messages, 1 and 2 carry standard output and standard error.
    timeout --kill-after=10 $((limit + 60)) taskset --cpu-list "$processor" \
        env --ignore-environment PATH=/usr/bin:/bin TMPDIR="$memory_folder" LD_LIBRARY_PATH="$cache" \
        ./linux mem="${WITH_VCAN_MEMORY:-3072M}" uml_dir="$run" umid=guest seccomp=auto quiet \
        root=/dev/root rootfstype=hostfs rootflags=/ ro noreboot panic=-1 \
        init="$here/vcan-guest.sh" VCAN_GUEST="$run" \
        con=null ssl=null con0=null,fd:5 con1=null,fd:3 con2=null,fd:4 \
        </dev/null >"$run/kernel.log" 2>&1 5>"$run/boot.log" &
    guest=$!
    trap 'kill -TERM $guest 2>/dev/null' INT TERM HUP
    while kill -0 $guest 2>/dev/null; do
        wait $guest # ends early at a signal
    done
    if ! status=$(cat "$run/status" 2>/dev/null); then
        tail --lines=20 "$run/kernel.log" "$run/boot.log" >&2
        give_up "the guest did not start, or died"
    fi
    [ "$status" != 124 ] || echo "with-vcan: stopped after $limit s" >&2
    exit "$status"
}

[ $# -gt 0 ] || give_up "usage: $0 COMMAND [ARGUMENT...]"
if [ "${WITH_VCAN_GUEST:-}" != always ] && inside=$(namespace); then
    # shellcheck disable=SC2086 # one word per option
    exec timeout --kill-after=10 "$limit" $inside sh -c "$links"'
exec "$@"' with-vcan "$@"
fi
[ "$(id -u)" = 0 ] || give_up "this kernel has no vcan, and the guest needs root"
for program in ip insmod; do
    PATH=$PATH:/usr/sbin:/sbin command -v "$program" >/dev/null ||
        give_up "this kernel has no vcan, and the guest needs the packages iproute2 and kmod"
done
[ -x "$cache/linux" ] || get_kernel ||
    give_up "this kernel has no vcan, and no User-Mode-Linux kernel could be fetched"
run_in_guest "$@"
