#!/bin/sh
# Writes this installation's configuration, then executes nginx.
set -eu
nameserver=$(awk '/^nameserver/ { print $2; exit }' /etc/resolv.conf)
case "$nameserver" in *:*) nameserver="[$nameserver]" ;; esac
echo "resolver $nameserver valid=5s;" > /tmp/resolver.conf

# compose.tls.yaml asks for TLS and publishes every address: without it, keys would go there in clear text.
if [ -n "${TLS:-}" ] || [ -e /run/secrets/tls_certificate ]; then
  for file in /run/secrets/tls_certificate /run/secrets/tls_key; do
    if [ ! -r "$file" ]; then
      echo "start.sh: TLS is asked for, but user $(id -u) cannot read $file. Let it read the file that TLS_CERTIFICATE" \
        "or TLS_KEY names." >&2
      exit 1
    fi
  done
  cat > /tmp/listen.conf <<'TLS'
listen 8443 ssl;
ssl_certificate /run/secrets/tls_certificate;
ssl_certificate_key /run/secrets/tls_key;
ssl_protocols TLSv1.2 TLSv1.3;
ssl_session_cache shared:tls:5m;
ssl_session_tickets off;
add_header Strict-Transport-Security "max-age=31536000" always;
listen 8080;
if ($scheme = http) {
    return 308 https://$host$request_uri;
}
TLS
else
  echo "listen 8080;" > /tmp/listen.conf
fi
exec nginx -c /etc/biresnerf/nginx.conf -g "daemon off;"
