extends SceneTree
# Does with the client what a scenario says, and writes down what came of it: test_godot.py writes the one and reads the
# other. Numbers beyond 2^53 come as text, bytes as base64, for the engine's JSON has only floats.

const BotClient = preload("res://addons/bots/bot_client.gd")
const FeatureTable = preload("res://addons/bots/feature_table.gd")
const Msgpack = preload("res://addons/bots/msgpack.gd")
const Rays = preload("res://addons/bots/rays.gd")
const Replies = preload("res://addons/bots/replies.gd")

var _scenario := {}
var _results := {}
var _ticks := 0


func _initialize() -> void:
	_scenario = JSON.parse(_read_file(_argument("scenario"))).result
	_results["codec"] = _codec(_scenario["codec"])
	_results["read"] = _read_replies(_scenario["read"])
	_results["refused_here"] = _refused_here(int(_scenario["closed_port"]))
	_results["hostile"] = _hostile(_scenario["hostile"])
	_results["said"] = _say_all(_scenario["said"])
	_results["play"] = _play(_scenario["play"])
	_build_room()


# The physics knows what was added after a tick.
func _iteration(_delta: float) -> bool:
	_ticks += 1
	if _ticks != 3:
		return false
	_results["rays"] = _cast(_scenario["rays"])
	var file := File.new()
	file.open(_argument("out"), File.WRITE)
	for name in _results:
		var results = _results[name]
		for result in results if results is Array else [results]:
			file.store_line(JSON.print([name, result]))  # a line each: the engine prints long JSON in quadratic time
	file.close()
	quit()
	return false


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
		var decoded := Msgpack.decode(_bytes(case))
		if decoded["ok"]:
			results.append({"shown": _shown(decoded["value"]), "again": Msgpack.encode(decoded["value"]).hex_encode()})
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
		var reply := Replies.read(_bytes(case["body"]), message, welcome)
		if welcome == null:
			welcome = reply
		results.append({"ok": reply["ok"], "code": reply.get("code"), "detail": reply.get("detail")})
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
	return _codes(results)


func _say(client: BotClient, message: Dictionary) -> Dictionary:
	var options := {}
	for name in message:
		if not name in ["type", "count", "frame", "bots", "free", "acquired", "values"]:
			options[name] = message[name]
	for name in ["seeds", "failed"]:
		if options.has(name):
			options[name] = _ints(options[name]) if name == "seeds" else _places(options[name])
	match message["type"]:
		"hello":
			return client.hello(message.get("token"), message.get("bundle"), message.get("cost_model"))
		"start_bots":
			return client.start(int(message["count"]), options)
		"request_queries":
			return client.query(_ints(message["bots"]), int(message["frame"]), message["free"], options)
		"submit_features":
			var acquired := _places(message["acquired"])
			return client.act(_ints(message["bots"]), int(message["frame"]), acquired, message["values"], options)
		"stop_bots":
			return client.stop(_ints(message["bots"]))
	client.close()
	return {"ok": not client.is_open()}


func _play(play: Dictionary) -> Dictionary:
	var client := BotClient.new()
	client.connect_to("127.0.0.1", int(play["port"]))
	client.hello()
	var table: FeatureTable = client.welcome["table"]
	var started := client.start(int(play["count"]), {"seeds": _ints(play["seeds"]), "budgets_us": play["budgets_us"]})
	var bots: Array = started["bots"]
	var frames := []
	var errors := []
	for inputs in play["frames"]:
		var frame := int(inputs["frame"])
		var free := _rows(inputs["free"], bots.size())
		var asked := _begun_and_polled(client, bots, frame, free)
		var acquired: Array = asked["asked"].duplicate()
		var failed := []
		for i in range(bots.size()):
			var fails: bool = inputs["fails"] and acquired[i].size() > 0
			failed.append([acquired[i][0]] if fails else [])
			acquired[i] = Array(acquired[i]).slice(1, acquired[i].size()) if fails else acquired[i]
		var values := _values(table, acquired, _rows(inputs["costly"], bots.size()))
		if frame == int(play["errors_at"]):
			errors = _errors(client, bots, frame, free, acquired, values)
			errors.append(JSON.print(client.query(bots, frame, free, {"rewards": _quarters(bots)})) == JSON.print(asked))
		var options := {"failed": failed} if inputs["fails"] else {}
		var acted := client.act(bots, frame, acquired, values, options)
		if frame == int(play["errors_at"]):
			errors.append(JSON.print(client.act(bots, frame, acquired, values, options)) == JSON.print(acted))
		frames.append(_seen(asked, acted))
	errors.append(client.stop(bots)["count"])
	client.close()
	return {"frames": frames, "errors": errors, "late": client.n_late}


# The form that never waits; a second request meanwhile is refused and changes nothing.
func _begun_and_polled(client: BotClient, bots: Array, frame: int, free: Array) -> Dictionary:
	client.begin_query(bots, frame, free, {"rewards": _quarters(bots)})
	var busy: String = client.begin_stop(bots)["code"]
	var reply = client.poll()
	while reply == null:
		OS.delay_usec(100)
		reply = client.poll()
	return reply if busy == "BUSY" else {"ok": false}


func _errors(client: BotClient, bots: Array, frame: int, free: Array, acquired: Array, values: Array) -> Array:
	var none := []
	var nothing := []
	for _bot in bots:
		none.append(PoolIntArray())
		nothing.append(PoolRealArray())
	var high := free.duplicate(true)
	high[0][0] = 1e9
	var other := free.duplicate(true)
	other[0][0] += 0.5
	return _codes([
		client.query([bots[0] + (1 << 40)], frame + 1, [free[0]]),
		client.query(bots, frame - 1, free),
		client.query(bots, frame, other, {"rewards": _quarters(bots)}),
		client.query(bots, frame + 1, high),
		client.query(bots, frame, [free[0]]),
		client.query(bots, frame, free, {"reward": _quarters(bots)}),
		client.act(bots, frame + 1, acquired, values),
		client.act(bots, frame, none, nothing),
		client.act(bots, frame, acquired, nothing),
		client.start(1 << 16),
		client.start(1, {"seeds": [0.5]}),
	])


func _codes(replies: Array) -> Array:
	var codes := []
	for reply in replies:
		codes.append("OK" if reply["ok"] else reply["code"])
	return codes


func _seen(asked: Dictionary, acted: Dictionary) -> Dictionary:
	var places := []
	var actions := StreamPeerBuffer.new()
	for row in asked["asked"]:
		places.append(Array(row))
	for row in acted["actions"]:
		for number in row:
			actions.put_float(number)
	return {
		"asked": places, "cost_us": _shown(asked["cost_us"]), "actions": actions.data_array.hex_encode(),
		"reasons": Array(acted["reasons"]), "turns": acted["turns"], "frame": acted["frame"]}


func _values(table: FeatureTable, acquired: Array, costly: Array) -> Array:
	var rows := []
	for i in range(acquired.size()):
		var row := PoolRealArray()
		for place in acquired[i]:
			var at := 0
			for before in range(place):
				at += table.costly[before]["size"]
			for j in range(table.costly[place]["size"]):
				row.append(costly[i][at + j])
		rows.append(row)
	return rows


func _build_room() -> void:
	for each in _scenario["rays"]["boxes"]:
		var body = Area.new() if each["group"] == "lava" else StaticBody.new()
		var shape := BoxShape.new()
		shape.extents = Vector3(each["half"][0], each["half"][1], each["half"][2])
		var collision := CollisionShape.new()
		collision.shape = shape
		body.add_child(collision)
		body.translation = Vector3(each["middle"][0], each["middle"][1], each["middle"][2])
		body.add_to_group(each["group"])
		body.name = each["group"]
		get_root().add_child(body)


func _cast(rays: Dictionary) -> Dictionary:
	var table := FeatureTable.new()
	for feature in rays["features"]:
		feature["size"] = int(feature["size"])
	var fault := table.read(rays["features"])
	var caster := Rays.new()
	var set_up := caster.setup(table, rays["classes"])
	var eye := Transform(Basis(Vector3.UP, deg2rad(rays["heading_deg"])), Vector3(0, 1.2, 0))
	var own := [get_root().get_node("own")]
	var space := get_root().get_world().direct_space_state
	var everything := PoolIntArray(range(table.n_queries))
	return {
		"fault": fault, "ok": set_up["ok"], "wrong_classes": caster.setup(table, ["nothing"])["code"],
		"again": caster.setup(table, rays["classes"])["ok"], "all": Array(caster.cast(space, eye, everything, own)),
		"one": Array(caster.cast(space, eye, PoolIntArray([1]), own)),
		"none": Array(caster.cast(space, eye, PoolIntArray(), own))}


func _quarters(bots: Array) -> Array:
	var rewards := []
	for _bot in bots:
		rewards.append(0.25)
	return rewards


func _ints(numbers: Array) -> Array:
	var ints := []
	for number in numbers:
		ints.append(int(number))
	return ints


func _places(rows: Array) -> Array:
	var places := []
	for row in rows:
		var set := PoolIntArray()
		for i in range(row.size()):
			if row[i] == 1:
				set.append(i)
		places.append(set)
	return places


func _rows(base64: String, count: int) -> Array:
	var source := StreamPeerBuffer.new()
	source.data_array = _bytes(base64)
	var rows := []
	for _i in range(count):
		var row := []
		for _j in range(source.get_size() / 4 / count):
			row.append(source.get_float())
		rows.append(row)
	return rows


func _bytes(base64: String) -> PoolByteArray:
	return Marshalls.base64_to_raw(base64) if base64 != "" else PoolByteArray()


# A value as JSON can carry it without a change; test_godot.py shows its own in the same way.
func _shown(value):
	var bits := StreamPeerBuffer.new()
	bits.big_endian = true
	match typeof(value):
		TYPE_INT:
			return "i%d" % value
		TYPE_REAL:
			bits.put_double(value)
			return "f" + bits.data_array.hex_encode()
		TYPE_STRING:
			return "s" + value.to_utf8().hex_encode()
		TYPE_RAW_ARRAY:
			return "b" + value.hex_encode()
		TYPE_ARRAY:
			var shown := []
			for each in value:
				shown.append(_shown(each))
			return shown
		TYPE_DICTIONARY:
			var shown := {}
			for key in value:
				shown[key.to_utf8().hex_encode()] = _shown(value[key])
			return shown
	return value
