extends Reference
# One connection to a server of bots over TCP: which costly features to acquire for each bot, and then what to do.
#
# Every request has two forms. `query(...)` waits for the reply, at most `timeout_s`, and returns it; `begin_query(...)`
# only sends, and poll() returns the reply once it is there and null until then, without ever waiting. One request at a
# time. Replies are Dictionaries with `ok`; where that is false they have `code`, `detail` and `retry_after_s`
# (errors.gd). After those of _ENDING that came with a reply, or for want of one, the socket is closed and the bots have
# ended: connect and say hello again. After any other failure nothing has changed.
#
# This file knows nothing about rays: see rays.gd. N bots, F free numbers, M costly features, A numbers of an action.

const Errors = preload("errors.gd")
const Frames = preload("frames.gd")
const Msgpack = preload("msgpack.gd")
const Replies = preload("replies.gd")
const Requests = preload("requests.gd")

const _LOOK_USEC := 20  # between two looks at the socket while a call waits; the system makes more of it
const _FAREWELL_S := 0.5

# After these nothing else is answered on the socket.
const _ENDING := [
	Errors.CONNECTION_LOST, Errors.TIMED_OUT, Errors.BAD_REPLY, "NO_CONNECTION", "TOO_LARGE", "TOO_MANY_CONNECTIONS"
]

var timeout_s := 5.0
var welcome = null  # what `hello` was answered; `welcome.table` is a feature_table.gd
var n_late := 0  # replies that came too late by this clock, or left so by the server's
var _frames := Frames.new()
var _waiting_for = null  # the message that was sent, or {"type": "connect"}
var _began_usec := 0


func connect_to(host: String, port: int) -> Dictionary:
	return _finished(begin_connect(host, port))


func begin_connect(host: String, port: int) -> Dictionary:
	drop()
	var begun: Dictionary = _frames.open(host, port)
	if begun["ok"]:
		_wait_for({"type": "connect"})
	return begun


# Open a connection: {"ok", "bundle", "table", "action" [A], "budget_us", "cost_model", ...}, which stays in `welcome`.
# `bundle` is NAME or NAME@VERSION; `cost_model` is {"call_us", "feature_us" [M]} of this engine on this machine.
func hello(token = null, bundle = null, cost_model = null) -> Dictionary:
	return _finished(begin_hello(token, bundle, cost_model))


func begin_hello(token = null, bundle = null, cost_model = null) -> Dictionary:
	return _begin(Requests.hello(token, bundle, cost_model))


# Start bots: {"ok", "bots"}, their handles. Options, each with one entry a bot: `seeds`, `target_returns`,
# `budgets_us`, `target_costs_us`.
func start(count: int, options := {}) -> Dictionary:
	return _finished(begin_start(count, options))


func begin_start(count: int, options := {}) -> Dictionary:
	return _begin(Requests.start(count, options)) if welcome != null else _no_connection()


# Which costly features to acquire: {"ok", "frame", "asked" [N] PoolIntArrays of places in `welcome.table.costly`,
# "cost_us" [N], "reasons" [N], "infer_us", "late"}. `free` has F numbers a bot. Options: `rewards` [N] since each bot's
# last frame, `budgets_us` and `target_costs_us` [N] of this frame only, `frame_budget_us`, `deadline_us`.
func query(bots: Array, frame: int, free: Array, options := {}) -> Dictionary:
	return _finished(begin_query(bots, frame, free, options))


func begin_query(bots: Array, frame: int, free: Array, options := {}) -> Dictionary:
	if welcome == null:
		return _no_connection()
	return _begin(Requests.query(welcome["table"], bots, frame, free, options))


# What to do: {"ok", "frame", "actions" [N] PoolRealArrays of A, "reasons" [N], "turns" [N] or null, "infer_us", "late"}.
# `acquired` as `asked` of the query, `values` [N] arrays of all numbers of those features. Options: `failed` [N] as
# `asked`, what could not be acquired; `acquire_us`, what acquiring took over all bots; `deadline_us`.
func act(bots: Array, frame: int, acquired: Array, values: Array, options := {}) -> Dictionary:
	return _finished(begin_act(bots, frame, acquired, values, options))


func begin_act(bots: Array, frame: int, acquired: Array, values: Array, options := {}) -> Dictionary:
	if welcome == null:
		return _no_connection()
	return _begin(Requests.act(welcome["table"], bots, frame, acquired, values, options))


# End these bots: {"ok", "count"}.
func stop(bots: Array) -> Dictionary:
	return _finished(begin_stop(bots))


func begin_stop(bots: Array) -> Dictionary:
	return _begin(Requests.stop(bots)) if welcome != null else _no_connection()


# The reply to what was begun; null while it is not there, or where nothing was begun. Never waits.
func poll():
	if _waiting_for == null:
		return null
	var came = _frames.poll()
	if came == null:
		if OS.get_ticks_usec() - _began_usec < 1e6 * timeout_s:
			return null
		came = Errors.failure(Errors.TIMED_OUT, "no answer within %s s" % timeout_s)
	var message: Dictionary = _waiting_for
	_waiting_for = null
	if came["ok"] and message["type"] != "connect":
		came = _read(came["body"], message)
	if not came["ok"] and came["code"] in _ENDING:
		drop()
	return came


func is_waiting() -> bool:
	return _waiting_for != null


func is_open() -> bool:
	return _frames.state != Frames.CLOSED


# End the connection and its bots. A server that is gone already is no error.
func close() -> void:
	if welcome != null and not is_waiting():
		var patience_s := timeout_s
		timeout_s = min(timeout_s, _FAREWELL_S)
		_finished(_begin({"ok": true, "message": {"type": "goodbye"}}))
		timeout_s = patience_s
	drop()


# The same without a word, so without a wait: what a game does that is about to end.
func drop() -> void:
	_frames.close()
	_waiting_for = null
	welcome = null


func _begin(asked: Dictionary) -> Dictionary:
	if not asked["ok"]:
		return asked
	if is_waiting():
		return Errors.failure(Errors.BUSY, "the reply to %s has not come" % _waiting_for["type"])
	if not is_open():
		return Errors.failure(Errors.CONNECTION_LOST, "not connected")
	var message: Dictionary = asked["message"]
	_wait_for(message)
	var body := Msgpack.encode(message)
	if welcome != null and body.size() > welcome["max_body_bytes"]:
		_waiting_for = null
		return Errors.failure("TOO_LARGE", "%d bytes, at most %d" % [body.size(), welcome["max_body_bytes"]])
	var begun: Dictionary = _frames.send(body, Replies.most_bytes(message, welcome))
	if not begun["ok"]:
		drop()
	return begun


func _wait_for(message: Dictionary) -> void:
	_waiting_for = message
	_began_usec = OS.get_ticks_usec()


func _finished(begun: Dictionary) -> Dictionary:
	if not begun["ok"]:
		return begun
	var came = poll()
	while came == null:
		OS.delay_usec(_LOOK_USEC)
		came = poll()
	return came


func _read(body: PoolByteArray, message: Dictionary) -> Dictionary:
	var result := Replies.read(body, message, welcome)
	if not result["ok"]:
		return result
	if message["type"] == "hello":
		welcome = result
	elif message.has("frame"):
		var deadline_us = message.get("deadline_us", welcome.get("deadline_us"))
		if deadline_us != null and OS.get_ticks_usec() - _began_usec > deadline_us:
			result["late"] = true  # whatever the server says, who cannot know when this was sent or read
		n_late += int(result["late"])
	return result


func _no_connection() -> Dictionary:
	return Errors.failure("NO_CONNECTION", "say hello first")
