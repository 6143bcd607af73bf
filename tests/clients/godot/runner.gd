extends SceneTree
# Does with the client what a scenario says, and writes down what came of it: test_godot.py writes the one and reads the
# other. Numbers beyond 2^53 come as text, bytes as base64, for the engine's JSON has only floats.

const BotClient = preload("res://addons/bots/bot_client.gd")
const Forms = preload("forms.gd")
const Msgpack = preload("res://addons/bots/msgpack.gd")
const Replies = preload("res://addons/bots/replies.gd")
const Room = preload("room.gd")
const Turns = preload("turns.gd")

const LOOP_FRAMES := 5
const MAX_TICKS := 600

var _scenario := {}
var _results := {}
var _ticks := 0
var _loop = null


func _initialize() -> void:
	_scenario = JSON.parse(_read_file(_argument("scenario"))).result
	_results["codec"] = _codec(_scenario["codec"])
	_results["read"] = _read_replies(_scenario["read"])
	_results["refused_here"] = _refused_here(int(_scenario["closed_port"]))
	_results["hostile"] = _hostile(_scenario["hostile"])
	_results["said"] = _say_all(_scenario["said"])
	_results["play"] = Turns.play(_scenario["play"])
	Room.build(get_root(), _scenario["rays"])
	_loop = _loop_of(_scenario["loop"])


# The physics knows what was added after a tick; the loop goes on by itself.
func _iteration(_delta: float) -> bool:
	_ticks += 1
	if _ticks == 3:
		_results["rays"] = Room.cast(get_root(), _scenario["rays"])
	if _ticks == MAX_TICKS or (_ticks > 3 and (_loop == null or _loop.frame == LOOP_FRAMES)):
		_results["loop"] = {"frames": _loop.frame, "decided": _loop.walkers[0].n_decided} if _loop != null else {}
		_write()
		quit()
	return false


# The code of the README with a walker, in the tree.
func _loop_of(source: String) -> Node:
	var script := GDScript.new()
	script.source_code = source
	if script.reload() != OK:
		return null
	var loop = script.new()
	loop.walkers = [CountingWalker.new()]
	get_root().add_child(loop.walkers[0])
	get_root().add_child(loop)
	return loop


func _write() -> void:
	var file := File.new()
	file.open(_argument("out"), File.WRITE)
	for name in _results:
		var results = _results[name]
		for result in results if results is Array else [results]:
			file.store_line(JSON.print([name, result]))  # a line each: the engine prints long JSON in quadratic time
	file.close()


func _argument(name: String) -> String:
	for argument in OS.get_cmdline_args():
		if argument.begins_with("--%s=" % name):
			return argument.split("=")[1]
	return ""


func _read_file(path: String) -> String:
	var file := File.new()
	file.open(path, File.READ)
	return file.get_as_text()


func _codec(cases: Array) -> Array:
	var results := []
	for case in cases:
		var decoded := Msgpack.decode(Forms.bytes(case))
		if decoded["ok"]:
			results.append({"shown": Forms.shown(decoded["value"]), "again": Msgpack.encode(decoded["value"]).hex_encode()})
		else:
			results.append({"fault": decoded["detail"]})
	return results


func _read_replies(cases: Array) -> Array:
	var results := []
	var welcome = null
	for case in cases:
		var message: Dictionary = case["message"].duplicate()
		for name in ["frame", "count"]:
			if message.has(name):
				message[name] = int(message[name])
		var reply := Replies.read(Forms.bytes(case["body"]), message, welcome)
		if welcome == null:
			welcome = reply
		results.append({"ok": reply["ok"], "code": reply.get("code")})
	return results


# What fails before anything is sent.
func _refused_here(closed_port: int) -> Dictionary:
	var client := BotClient.new()
	return {
		"no_hello": client.query([1], 0, [[0.0]])["code"],
		"no_socket": client.hello()["code"],
		"closed_port": client.connect_to("127.0.0.1", closed_port)["code"],
		"no_port": client.connect_to("127.0.0.1", 65536)["code"],
		"poll": client.poll(),
	}


func _hostile(hostile: Dictionary) -> Array:
	var results := []
	for case in hostile["cases"]:
		var client := BotClient.new()
		client.timeout_s = case["timeout_s"]
		var reply := client.connect_to("127.0.0.1", int(hostile["port"]))
		if reply["ok"]:
			reply = client.hello()
		if reply["ok"] and case["query"]:
			reply = client.query([1 << 32, (1 << 32) + 1], 7, [[0, 0, 0], [0, 0, 0]], {"deadline_us": 0})
		results.append({
			"ok": reply["ok"], "code": reply.get("code"), "retry_after_s": reply.get("retry_after_s"),
			"late": reply.get("late"), "n_late": client.n_late, "is_open": client.is_open()})
		client.drop()
	return results


func _say_all(said: Dictionary) -> Array:
	var client := BotClient.new()
	var results := [client.connect_to("127.0.0.1", int(said["port"]))]
	for message in said["messages"]:
		results.append(_say(client, message))
	return Forms.codes(results)


func _say(client: BotClient, message: Dictionary) -> Dictionary:
	var options := {}
	for name in message:
		if not name in ["type", "count", "frame", "bots", "free", "acquired", "values"]:
			options[name] = message[name]
	for name in ["seeds", "failed"]:
		if options.has(name):
			options[name] = Forms.ints(options[name]) if name == "seeds" else Forms.places(options[name])
	match message["type"]:
		"hello":
			return client.hello(message.get("token"), message.get("bundle"), message.get("cost_model"))
		"start_bots":
			return client.start(int(message["count"]), options)
		"request_queries":
			return client.query(Forms.ints(message["bots"]), int(message["frame"]), message["free"], options)
		"submit_features":
			var acquired := Forms.places(message["acquired"])
			return client.act(Forms.ints(message["bots"]), int(message["frame"]), acquired, message["values"], options)
		"stop_bots":
			return client.stop(Forms.ints(message["bots"]))
	client.close()
	return {"ok": not client.is_open()}


class CountingWalker:
	extends "res://demo/walker.gd"

	var n_decided := 0

	func decide(action: PoolRealArray) -> void:
		n_decided += 1
		.decide(action)
