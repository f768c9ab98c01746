#!/bin/sh
# The life of the Debian package on a minimal Debian under systemd, as root: life.sh PACKAGE NEXT-VERSION RIDE
# Called in a guest by test_life.py; the bus is can0, as the package has it. The first thing that is not so ends it.
set -eu
package=$1 newer=$2 ride=$3
export DEBIAN_FRONTEND=noninteractive LC_ALL=C HOME=/root PATH=/usr/sbin:/usr/bin:/sbin:/bin
unit=gz-onboard.service page=gz-onboard-dashboard.service bridge=gz-onboard-mqtt.service
settings=/etc/default/gz-onboard network=/etc/systemd/network/80-can0.network

step() { echo "--- $*"; }

fail() {
    echo "FAILED: $*"
    journalctl --no-pager -n 40 -u "$unit" -u "$page" -u "$bridge" || true
    exit 1
}

# wait_for WHAT COMMAND...: until it succeeds, for ten minutes.
wait_for() {
    what=$1 tries=1200
    shift
    until "$@" >/dev/null 2>&1; do
        tries=$((tries - 1))
        [ $tries -gt 0 ] || fail "no $what"
        sleep 0.5
    done
}

# apt ARGUMENT...: without a network, with nothing that is only recommended, with nobody to answer.
apt() {
    apt-get -qq -y --no-install-recommends -o Dpkg::Use-Pty=0 -o Dpkg::Options::=--force-unsafe-io \
        -o Dpkg::Options::=--force-confold "$@" </dev/null >/run/apt.log 2>&1 || { cat /run/apt.log; fail "apt-get $*"; }
}

# Every file of the root, with the sums of those in /etc; not what apt and dpkg keep for themselves, nor backups of users.
files() {
    find / -xdev \( -path /var/lib/apt -o -path /var/cache -o -path /var/lib/dpkg -o -path /var/log -o -path /tmp \) -prune \
        -o ! -path '/etc/*-' -printf '%y %m %u:%g %p %l\n' | sort
    find /var/log ! -path '/var/log/apt*' ! -name dpkg.log | sort
    find /etc -type f ! -name '*-' -exec md5sum {} + | sort -k 2
    find /var/lib/dpkg/info | sort
}

main_pid() { systemctl show --property=MainPID --value "$unit"; }
listening() { [ "$(main_pid)" != 0 ] && systemctl --quiet is-active "$unit"; }
tells_range() { systemctl show --property=StatusText --value "$unit" | grep -q ' km'; }
saved() { [ -n "$(ls /var/lib/gz-onboard)" ]; }
page_answers() { python3.11 -c 'import urllib.request as u; u.urlopen("http://127.0.0.1:8000/", timeout=20).read()'; }
goes_on() { journalctl --no-pager -u "$unit" "_PID=$(main_pid)" | grep -q 'continuing from the state saved'; }
is_new() { listening && [ "$(main_pid)" != "$old" ]; }

step "the root is a clean one"
for tool in python3 python3.11 pip gcc make ip dbus-daemon; do
    ! command -v $tool || fail "$tool is here before"
done
files >/run/before

step "installs, with what it depends on and nothing else"
apt install "$package"
[ -z "$(dpkg --audit)" ] || fail "dpkg --audit: $(dpkg --audit)"
[ "$(systemctl is-enabled $unit)" = enabled ] || fail "$unit is not enabled"
for other in $page $bridge; do
    [ "$(systemctl is-enabled $other || true)" = disabled ] || fail "$other is enabled"
done
find /opt/gz-onboard -name '*.so*' -exec ldd {} + >/run/libraries 2>&1 || true
! grep -B 9 'not found' /run/libraries || fail "a library is missing"

step "has started, since can0 is there, and tells a range"
wait_for "daemon" listening
[ "$(stat -c %U "/proc/$(main_pid)")" = gz-onboard ] || fail "the daemon runs as $(stat -c %U "/proc/$(main_pid)")"
gz-onboard replay "$ride" --channel can0 --loop >/run/replay.log 2>&1 &
replay=$!
wait_for "range in the status" tells_range
systemctl --quiet enable "$page"
systemctl --no-block start "$page"
wait_for "page" page_answers
install -m 600 /dev/null /etc/gz-onboard-mqtt.toml
systemctl --quiet enable "$bridge"
systemctl start "$bridge" || fail "$bridge does not start without a broker"
wait_for "saved state" saved

step "keeps state and edited settings when upgraded"
echo '# Edited by the administrator.' | tee -a "$settings" >>"$network"
old=$(main_pid)
apt install "$newer"
[ "$(dpkg-query -W -f '${Version}' gz-onboard)" = 9.0 ] || fail "the version is not 9.0"
wait_for "new daemon" is_new
wait_for "word that it goes on from its state" goes_on
wait_for "range in the status" tells_range
wait_for "page" page_answers
grep -q 'Edited by' "$settings" && grep -q 'Edited by' "$network" || fail "edited settings were lost"
! grep -q 'Of version 9' "$settings" || fail "edited settings were replaced"

step "keeps them when removed, and leaves nothing when purged"
kill "$replay"
wait "$replay" || true
apt remove gz-onboard
! systemctl --quiet is-active "$unit" "$page" "$bridge" || fail "a service still runs"
grep -q 'Edited by' "$settings" && saved || fail "removed more than a removal may"
mv /usr/sbin/userdel /usr/sbin/groupdel /run/  # by then, what the package depends on may be gone
/var/lib/dpkg/info/gz-onboard.postrm purge || fail "the purge needs more than a Debian always has"
mv /run/userdel /run/groupdel /usr/sbin/
apt purge --auto-remove gz-onboard
[ -z "$(systemctl --failed --no-legend)" ] || fail "failed: $(systemctl --failed --no-legend)"
files >/run/after
diff /run/before /run/after || fail "the purge left or took something"
step "all as it was before"
