extends Reference
# What a server answers: bytes to a Dictionary that a game can use without looking twice. Whatever the bytes, the result
# is {"ok": true, ...}, the server's own error, or BAD_REPLY. This file knows nothing about sockets.
#
# N bots, M costly features, A numbers of an action.

const Errors = preload("errors.gd")
const FeatureTable = preload("feature_table.gd")
const Msgpack = preload("msgpack.gd")

const ANSWER_TO := {
	"hello": "welcome",
	"start_bots": "bots_started",
	"request_queries": "queries",
	"submit_features": "actions",
	"stop_bots": "bots_stopped",
	"goodbye": "farewell",
}
const _ROOM := 65536  # of a reply without its bots: errors, and what a newer server may add
const _ROOM_FOR_WELCOME := 1048576  # 1,024 features and as many components, with the longest names, take half of it


# The most bytes that the answer to such a message can have.
static func most_bytes(message: Dictionary, welcome) -> int:
	if message["type"] == "hello":
		return _ROOM_FOR_WELCOME
	var bots: int = message["count"] if message.has("count") else message.get("bots", []).size()
	var of_a_bot: int = 64
	if welcome != null:
		of_a_bot += welcome["table"].n_queries / 8 + 4 * welcome["action"].size()
	return _ROOM + bots * of_a_bot


# The answer to `message`.
static func read(body: PoolByteArray, message: Dictionary, welcome) -> Dictionary:
	var decoded := Msgpack.decode(body)
	if not decoded["ok"] or typeof(decoded["value"]) != TYPE_DICTIONARY:
		return _bad("the reply is no map of msgpack. %s" % decoded.get("detail", ""))
	var reply: Dictionary = decoded["value"]
	var kind := str(reply.get("type"))
	if kind == "error":
		return Errors.refusal(reply)
	if kind != ANSWER_TO[message["type"]]:
		return _bad("the reply to %s is %s" % [message["type"], kind.left(80)])
	if message.has("frame") and (typeof(reply.get("frame")) != TYPE_INT or reply["frame"] != message["frame"]):
		return _bad("the reply is for frame %s, expected %d" % [str(reply.get("frame")).left(80), message["frame"]])
	match kind:
		"welcome":
			return _welcome(reply)
		"bots_started":
			return _bots_started(reply, message["count"])
		"queries":
			return _queries(reply, message["bots"].size(), welcome["table"])
		"actions":
			return _actions(reply, message["bots"].size(), welcome["action"].size())
		"bots_stopped":
			return {"ok": true, "count": reply["count"]} if typeof(reply.get("count")) == TYPE_INT else _bad("no count")
	return {"ok": true}


static func _bad(detail: String) -> Dictionary:
	return Errors.failure(Errors.BAD_REPLY, detail)


static func _welcome(reply: Dictionary) -> Dictionary:
	for name in ["features", "action", "cost_model"]:
		if typeof(reply.get(name)) != TYPE_DICTIONARY:
			return _bad("welcome.%s is no map" % name)
	var table := FeatureTable.new()
	var fault := table.read(reply["features"].get("features"))
	if fault != "":
		return _bad("welcome.%s" % fault)
	var components = reply["action"].get("components")
	if typeof(components) != TYPE_ARRAY or components.empty() or components.size() > FeatureTable.MAX_FEATURES:
		return _bad("welcome.action has no list of 1 to %d components" % FeatureTable.MAX_FEATURES)
	for each in components:
		if not _is_component(each):
			return _bad("no component of an action: %s" % str(each).left(80))
	if not _is_cost_model(reply["cost_model"], table.n_queries):
		return _bad("welcome.cost_model is none for %d costly features" % table.n_queries)
	for name in ["connection", "bundle"]:
		if typeof(reply.get(name)) != TYPE_STRING:
			return _bad("welcome.%s is no text" % name)
	for name in ["max_body_bytes", "max_bots", "context_length"]:
		if typeof(reply.get(name)) != TYPE_INT:
			return _bad("welcome.%s is no int" % name)
	for name in ["budget_us", "deadline_us", "target_cost_us", "cost_quantile", "target_return"]:
		if reply.get(name) != null and not FeatureTable.is_number(reply[name]):
			return _bad("welcome.%s is no number" % name)
	if reply.get("budget_us") == null:
		return _bad("welcome has no budget_us")
	if not _is_version(reply) or not typeof(reply.get("replay_frames")) in [TYPE_NIL, TYPE_INT]:
		return _bad("welcome's bundle_version, bundle_sha256 or replay_frames is none")
	var welcome := reply.duplicate()  # what a newer server says beyond is kept too
	welcome["ok"] = true
	welcome["table"] = table
	welcome["action"] = components
	return welcome


static func _is_component(each) -> bool:
	if typeof(each) != TYPE_DICTIONARY or not FeatureTable.is_name(each.get("name")):
		return false
	if not FeatureTable.is_range(each.get("low"), each.get("high")) or not FeatureTable.is_number(each.get("safe")):
		return false
	return each["low"] <= each["safe"] and each["safe"] <= each["high"]


static func _is_cost_model(model: Dictionary, n_queries: int) -> bool:
	if not _are_numbers(model.get("feature_us"), n_queries) or not FeatureTable.is_cost(model.get("call_us")):
		return false
	for us in model["feature_us"]:
		if not FeatureTable.is_cost(us):
			return false
	return true


static func _bots_started(reply: Dictionary, count: int) -> Dictionary:
	var bots = reply.get("bots")
	var names := {}
	if typeof(bots) == TYPE_ARRAY:
		for handle in bots:
			if typeof(handle) == TYPE_INT and handle >= 0:
				names[handle] = true
	if typeof(bots) != TYPE_ARRAY or bots.size() != count or names.size() != count:
		return _bad("bots_started has not %d different handles" % count)
	if not _is_version(reply):
		return _bad("bots_started's bundle_version or bundle_sha256 is none")
	var version = reply.get("bundle_version")
	return {"ok": true, "bots": bots, "bundle_version": version, "bundle_sha256": reply.get("bundle_sha256")}


static func _is_version(reply: Dictionary) -> bool:
	var is_number := typeof(reply.get("bundle_version")) in [TYPE_NIL, TYPE_INT]
	return is_number and typeof(reply.get("bundle_sha256")) in [TYPE_NIL, TYPE_STRING]


static func _queries(reply: Dictionary, count: int, table: FeatureTable) -> Dictionary:
	var asked = _unpack_bits(reply.get("queries"), count, table.n_queries)
	var reasons = _reasons(reply.get("reasons"), count)
	if asked == null or reasons == null or not _are_numbers(reply.get("cost_us"), count):
		return _bad("queries has not queries, cost_us and reasons of %d bots" % count)
	if not FeatureTable.is_number(reply.get("infer_us")):
		return _bad("queries has no infer_us")
	return {
		"ok": true, "frame": reply["frame"], "asked": asked, "cost_us": reply["cost_us"], "reasons": reasons,
		"infer_us": float(reply["infer_us"]), "late": _is_late(reply),
	}


static func _actions(reply: Dictionary, count: int, size: int) -> Dictionary:
	var actions = _unpack_floats(reply.get("actions"), count, size)
	var reasons = _reasons(reply.get("reasons"), count)
	if actions == null or reasons == null or reply.get("reasons") == null:
		return _bad("actions has not finite actions and reasons of %d bots" % count)
	var turns = reply.get("turns")
	if (turns != null and not _are_ints(turns, count)) or not FeatureTable.is_number(reply.get("infer_us")):
		return _bad("actions has no infer_us, or not turns of %d bots" % count)
	return {
		"ok": true, "frame": reply["frame"], "actions": actions, "reasons": reasons, "turns": turns,
		"infer_us": float(reply["infer_us"]), "late": _is_late(reply),
	}


static func _is_late(reply: Dictionary) -> bool:
	return typeof(reply.get("late")) == TYPE_BOOL and reply["late"]


static func _are_numbers(values, count: int) -> bool:
	if typeof(values) != TYPE_ARRAY or values.size() != count:
		return false
	for value in values:
		if not FeatureTable.is_number(value):
			return false
	return true


static func _are_ints(values, count: int) -> bool:
	if not _are_numbers(values, count):
		return false
	for value in values:
		if typeof(value) != TYPE_INT:
			return false
	return true


# [N] ints, 0 where it is null; null unless that is what they are.
static func _reasons(values, count: int):
	var reasons := PoolIntArray()
	if values != null and (typeof(values) != TYPE_ARRAY or values.size() != count):
		return null
	for i in range(count):
		var reason = 0 if values == null else values[i]
		if typeof(reason) != TYPE_INT or reason < 0 or reason > 255:
			return null
		reasons.append(reason)
	return reasons


# [N] PoolIntArrays of the bits that are set; null where the binary has another size or a bit beyond M.
static func _unpack_bits(binary, count: int, n_queries: int):
	var width := (n_queries + 7) / 8
	if typeof(binary) != TYPE_RAW_ARRAY or binary.size() != width * count:
		return null
	var rows := []
	for i in range(count):
		var row := PoolIntArray()
		for j in range(width):
			var byte: int = binary[width * i + j]
			var bit := 8 * j
			while byte != 0:
				if byte & 1:
					row.append(bit)
				byte >>= 1
				bit += 1
		if row.size() > 0 and row[row.size() - 1] >= n_queries:
			return null
		rows.append(row)
	return rows


# [N] PoolRealArrays of `size`, exactly the float32 that came; null where the binary has another size or is not finite.
static func _unpack_floats(binary, count: int, size: int):
	if typeof(binary) != TYPE_RAW_ARRAY or binary.size() != 4 * count * size:
		return null
	var source := StreamPeerBuffer.new()
	source.data_array = binary
	var rows := []
	for _i in range(count):
		var row := PoolRealArray()
		for _j in range(size):
			var number := source.get_float()
			if is_nan(number) or is_inf(number):
				return null
			row.append(number)
		rows.append(row)
	return rows
