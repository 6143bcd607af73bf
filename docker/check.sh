#!/usr/bin/env bash
# Builds the image, runs `docker compose up`, checks what must hold, and takes everything down again.
# Needs a Docker engine. Where builds can reach the package registry only through the host: BUILD_NETWORK=host.
set -euo pipefail
cd "$(dirname "$0")/.."

if docker compose version >/dev/null 2>&1; then compose=(docker compose); else compose=(docker-compose); fi
compose+=(--project-name bots-check)
image=budgeted-bot-runtime
scratch=$(mktemp -d)
trap '"${compose[@]}" down --timeout 10 >/dev/null 2>&1; rm -rf "$scratch"' EXIT

fail() {
  echo "check.sh: $*" >&2
  "${compose[@]}" logs --tail 40 >&2 || true
  exit 1
}
in_image() { docker run --rm --entrypoint python "$image" -c "$1"; }

"${compose[@]}" --profile observability config -q || fail "compose.yaml is wrong"
"${compose[@]}" build
"${compose[@]}" up -d
server=$("${compose[@]}" ps -q server)
demo=$("${compose[@]}" ps -q demo)

status=$(timeout 300 docker wait "$demo") || fail "the demo did not end within 300 s"
summary=$("${compose[@]}" logs --no-color demo)
[ "$status" = 0 ] || fail "the demo exited with $status"
grep -q "mean return" <<<"$summary" || fail "the demo printed no summary"
grep -Eq "budget violations[^0-9]+0 of [0-9]+ turns" <<<"$summary" || fail "the summary does not say 0 violations"
docker cp "$demo:/app/out/demo.png" "$scratch/" || fail "the demo drew no picture"
grep -q PNG <(head -c 4 "$scratch/demo.png") || fail "the demo's picture is no PNG"

health=$(docker inspect --format '{{.State.Health.Status}}' "$server")
[ "$health" = healthy ] || fail "the server is $health"
[ "$(docker exec "$server" id -u)" != 0 ] || fail "the server runs as root"
[ "$(docker inspect --format '{{.Config.User}}' "$image")" = bot ] || fail "the image does not run as bot"
in_image "import importlib.util as i, sys; sys.exit(i.find_spec('torch') is not None)" || fail "there is torch in the image"
in_image "import onnxruntime, pybullet, matplotlib" || fail "the image lacks a run-time package"

docker stop --time 10 "$server" >/dev/null
[ "$(docker inspect --format '{{.State.ExitCode}}' "$server")" = 0 ] || fail "the server did not drain upon SIGTERM"

echo "$summary"
docker image inspect "$image" --format '{{.Size}}' |
  awk '{ printf "check.sh: all as it must be; image of %d MB, no torch, user bot\n", $1 / 1e6 }'
