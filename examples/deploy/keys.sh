#!/bin/sh
# Make keys of robot and controller, and the authority that vouches for both, in a folder.
#
#     sh examples/deploy/keys.sh KEYS [NAME OR ADDRESS OF THE ROBOT]
#
# Give each side authority.pem and its own two files. Keep authority.key away from both: it can
# make keys that the robot accepts.
set -eu
umask 077
mkdir -p "$1" && cd "$1"
host=${2:-localhost}
case $host in *[!0-9.]*) host=DNS:$host ;; *) host=IP:$host ;; esac
new="-newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 3650"
openssl req -x509 $new -subj /CN=authority -keyout authority.key -out authority.pem
for side in robot controller; do
  openssl req -x509 $new -subj /CN=$side -keyout $side.key -out $side.pem \
    -CA authority.pem -CAkey authority.key \
    -addext "subjectAltName=$host,DNS:localhost,IP:127.0.0.1" -addext basicConstraints=critical,CA:FALSE
done
