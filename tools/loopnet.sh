#!/bin/sh
# tools/loopnet.sh COMMAND [ARGUMENT...]
#
# Runs COMMAND where python-can's udp_multicast cannot leave the machine: in a network namespace
# of its own that has the loopback interface and nothing else, with a multicast route on it.
# All processes that shall share a bus must be started inside one call, for example:
#
#     tools/loopnet.sh sh -c 'ehadiag sim --interface udp_multicast & ehadiag bit ...'
#
# Exit status: that of COMMAND; 125 when the namespace cannot be made (neither root nor unprivileged
# user namespaces).
[ $# -gt 0 ] || { echo "usage: $0 COMMAND [ARGUMENT...]" >&2; exit 125; }

inside='ip link set lo up multicast on && ip route add 239.0.0.0/8 dev lo || exit 125
exec "$@"'

if unshare --net true 2>/dev/null; then
    exec unshare --net sh -c "$inside" loopnet "$@"
elif unshare --map-root-user --net true 2>/dev/null; then
    exec unshare --map-root-user --net sh -c "$inside" loopnet "$@"
fi
echo "$0: cannot make a network namespace: needs root or unprivileged user namespaces" >&2
exit 125
