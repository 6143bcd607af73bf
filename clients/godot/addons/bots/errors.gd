extends Reference
# What a failed call returns. Codes of the server are those of PROTOCOL.md; those that this client makes are below them.
# This file knows nothing about messages or sockets.

const OF_SERVER := [
	"BAD_MSGPACK", "BAD_JSON", "TOO_DEEP", "UNAUTHORIZED", "NO_BOT", "NO_BUNDLE", "NO_CONNECTION", "NO_ROUTE",
	"METHOD_NOT_ALLOWED", "FRAME_REUSED", "NO_PENDING_QUERY", "STALE_FRAME", "TOO_LARGE", "UNSUPPORTED_MEDIA_TYPE",
	"BAD_BUNDLE", "BAD_SCHEMA", "BAD_SHAPE", "MISSING_FEATURE", "NON_FINITE", "OUT_OF_RANGE", "OVER_BUDGET",
	"UNREQUESTED_FEATURE", "TOO_MANY_BOTS", "TOO_MANY_CONNECTIONS", "INTERNAL", "NOT_READY",
]
const BUSY := "BUSY"  # the reply to the request before has not come: poll() first. Nothing was sent
const CONNECT_FAILED := "CONNECT_FAILED"  # nobody listens there, or the host has no address
const CONNECTION_LOST := "CONNECTION_LOST"  # the server closed the socket; the bots have ended
const TIMED_OUT := "TIMED_OUT"  # no whole reply within timeout_s; the socket is closed and the bots have ended
const BAD_REPLY := "BAD_REPLY"  # the reply is none that the protocol allows here; the same


# A failed call: `code` for a program, `detail` for a person, `retry_after_s` a float, or null where waiting is no help.
static func failure(code: String, detail: String, retry_after_s = null) -> Dictionary:
	return {"ok": false, "code": code, "detail": detail, "retry_after_s": retry_after_s}


# What an `error` message says. A code that this client does not know is taken for INTERNAL.
static func refusal(reply: Dictionary) -> Dictionary:
	var code := str(reply.get("code"))
	var detail := str(reply.get("detail"))
	var retry_after_s = reply.get("retry_after_s")
	if typeof(retry_after_s) == TYPE_INT:
		retry_after_s = float(retry_after_s)
	elif typeof(retry_after_s) != TYPE_REAL:
		retry_after_s = null
	if not code in OF_SERVER:
		return failure("INTERNAL", "%s: %s" % [code, detail], retry_after_s)
	return failure(code, detail, retry_after_s)
