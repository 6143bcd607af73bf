extends Reference
# What a client asks, as the maps that go into msgpack. Shapes and types are checked before anything is sent; whether
# numbers are within their ranges the server says. This file knows nothing about bytes of a frame or sockets.
#
# Each function returns {"ok": true, "message"} or a failure. N bots, F free numbers, M costly features.

const Errors = preload("errors.gd")
const FeatureTable = preload("feature_table.gd")

const MAX_BOTS := 65536
const MAX_FRAME := 1 << 53


# `cost_model` is {"call_us", "feature_us" [M]}; each argument may be null.
static func hello(token, bundle, cost_model) -> Dictionary:
	var message := {"type": "hello", "protocol": 1}
	if cost_model != null:
		if typeof(cost_model) != TYPE_DICTIONARY or not FeatureTable.is_number(cost_model.get("call_us")):
			return _wrong("cost_model is no {call_us, feature_us}")
		var feature_us = _floats(cost_model.get("feature_us"), -1)
		if feature_us == null:
			return _wrong("cost_model.feature_us is no list of numbers")
		message["cost_model"] = {"call_us": float(cost_model["call_us"]), "feature_us": feature_us}
	for given in [["token", token], ["bundle", bundle]]:
		if given[1] != null:
			if typeof(given[1]) != TYPE_STRING:
				return _wrong("%s is no String" % given[0])
			message[given[0]] = given[1]
	return {"ok": true, "message": message}


# Options: `seeds`, ints; `target_returns`, `budgets_us`, `target_costs_us`, numbers; each of `count`.
static func start(count: int, options: Dictionary) -> Dictionary:
	if count < 1 or count > MAX_BOTS:
		return _wrong("count is %d, expected 1 to %d" % [count, MAX_BOTS])
	var message := {"type": "start_bots", "count": count}
	if options.get("seeds") != null:
		var fault := _ints_fault(options["seeds"], "seeds")
		if fault != "" or options["seeds"].size() != count:
			return _shape("seeds: %d ints of 0 to 2^63 - 1 expected. %s" % [count, fault])
		message["seeds"] = Array(options["seeds"])
	return _with_options(message, options, ["target_returns", "budgets_us", "target_costs_us"], [], count, ["seeds"])


# `bots` [N] handles; `free` [N] arrays of F numbers. Options: `rewards`, `budgets_us`, `target_costs_us` [N],
# `frame_budget_us`, `deadline_us`.
static func query(table: FeatureTable, bots: Array, frame: int, free: Array, options: Dictionary) -> Dictionary:
	var fault := _turn_fault(bots, frame)
	if fault != "":
		return _wrong(fault)
	if free.size() != bots.size():
		return _shape("free has %d rows, expected %d" % [free.size(), bots.size()])
	var numbers := PoolRealArray()
	for row in free:
		var packed = _packed(row, table.n_free)
		if packed == null:
			return _shape("a row of free is not %d numbers" % table.n_free)
		numbers.append_array(packed)
	var message := {"type": "request_queries", "frame": frame, "bots": bots, "free": _blob(numbers)}
	var of_each := ["rewards", "budgets_us", "target_costs_us"]
	return _with_options(message, options, of_each, ["frame_budget_us", "deadline_us"], bots.size(), [])


# `acquired` [N] arrays of costly features, increasing; `values` [N] arrays of their numbers, in that order. Options:
# `failed` [N] as `acquired`, `acquire_us`, `deadline_us`.
static func act(
	table: FeatureTable, bots: Array, frame: int, acquired: Array, values: Array, options: Dictionary
) -> Dictionary:
	var fault := _turn_fault(bots, frame)
	if fault != "":
		return _wrong(fault)
	if values.size() != bots.size():
		return _shape("values has %d rows, expected %d" % [values.size(), bots.size()])
	var message := {"type": "submit_features", "frame": frame, "bots": bots}
	fault = _put_bits(message, "acquired", acquired, bots.size(), table)
	if fault != "":
		return _shape(fault)
	var numbers := PoolRealArray()
	for i in range(bots.size()):
		var size := 0
		for feature in acquired[i]:
			size += table.sizes[feature]
		var packed = _packed(values[i], size)
		if packed == null:
			return _shape("row %d of values is not %d numbers" % [i, size])
		numbers.append_array(packed)
	message["values"] = _blob(numbers)
	if options.get("failed") != null:
		fault = _put_bits(message, "failed", options["failed"], bots.size(), table)
	if fault != "":
		return _shape(fault)
	return _with_options(message, options, [], ["acquire_us", "deadline_us"], bots.size(), ["failed"])


static func stop(bots: Array) -> Dictionary:
	var fault := _turn_fault(bots, 0)
	return {"ok": true, "message": {"type": "stop_bots", "bots": bots}} if fault == "" else _wrong(fault)


static func _wrong(detail: String) -> Dictionary:
	return Errors.failure("BAD_SCHEMA", detail)


static func _shape(detail: String) -> Dictionary:
	return Errors.failure("BAD_SHAPE", detail)


static func _turn_fault(bots: Array, frame: int) -> String:
	if frame < 0 or frame > MAX_FRAME:
		return "frame is %d, expected 0 to 2^53" % frame
	if bots.empty() or bots.size() > MAX_BOTS:
		return "%d bots, expected 1 to %d" % [bots.size(), MAX_BOTS]
	return _ints_fault(bots, "bots")


static func _ints_fault(values, name: String) -> String:
	if typeof(values) != TYPE_ARRAY and typeof(values) != TYPE_INT_ARRAY:
		return "%s is no Array" % name
	for value in values:
		if typeof(value) != TYPE_INT or value < 0:
			return "%s holds %s, expected ints of 0 to 2^63 - 1" % [name, str(value).left(80)]
	return ""


# Options that are null are left out; what is neither in one of the lists nor in `taken` is a mistake.
static func _with_options(
	message: Dictionary, options: Dictionary, of_each: Array, single: Array, count: int, taken: Array
) -> Dictionary:
	for name in options:
		var given = options[name]
		if name in of_each:
			var numbers = _floats(given, count)
			if given != null and numbers == null:
				return _shape("%s: %d numbers expected" % [name, count])
			if given != null:
				message[name] = numbers
		elif name in single:
			if given != null and typeof(given) != TYPE_INT and typeof(given) != TYPE_REAL:
				return _wrong("%s is no number" % name)
			if given != null:
				message[name] = float(given)
		elif not name in taken:
			return _wrong("there is no option %s" % str(name).left(80))
	return {"ok": true, "message": message}


# The numbers as floats; null unless they are `count` numbers (-1: however many).
static func _floats(values, count: int):
	if typeof(values) != TYPE_ARRAY and typeof(values) != TYPE_REAL_ARRAY and typeof(values) != TYPE_INT_ARRAY:
		return null
	if count >= 0 and values.size() != count:
		return null
	var numbers := []
	for value in values:
		if typeof(value) != TYPE_INT and typeof(value) != TYPE_REAL:
			return null
		numbers.append(float(value))
	return numbers


# The numbers of a row, null where it is none of so many numbers. What is packed already is not looked at one by one.
static func _packed(row, size: int):
	if typeof(row) == TYPE_ARRAY and _floats(row, size) == null:
		return null
	if typeof(row) != TYPE_ARRAY and typeof(row) != TYPE_REAL_ARRAY:
		return null
	return PoolRealArray(row) if row.size() == size else null


# float32, little-endian: how the engine writes such an array behind eight bytes of type and length. One call for all
# takes a tenth of one for each.
static func _blob(numbers: PoolRealArray) -> PoolByteArray:
	return var2bytes(numbers).subarray(8, 7 + 4 * numbers.size()) if numbers.size() > 0 else PoolByteArray()


# Set a field to bits [N, M]: bit i mod 8 of byte i / 8 of a row, from the least significant.
static func _put_bits(message: Dictionary, name: String, rows, count: int, table: FeatureTable) -> String:
	if typeof(rows) != TYPE_ARRAY or rows.size() != count:
		return "%s: %d rows expected" % [name, count]
	var width := (table.n_queries + 7) / 8
	var bits := PoolByteArray()
	bits.resize(width * count)
	for i in range(bits.size()):
		bits[i] = 0
	for i in range(count):
		var last := -1
		if typeof(rows[i]) != TYPE_ARRAY and typeof(rows[i]) != TYPE_INT_ARRAY:
			return "a row of %s is no Array and no PoolIntArray" % name
		for feature in rows[i]:
			if typeof(feature) != TYPE_INT or feature <= last or feature >= table.n_queries:
				return "a row of %s is not increasing within 0 to %d" % [name, table.n_queries - 1]
			bits[width * i + feature / 8] |= 1 << feature % 8
			last = feature
	message[name] = bits
	return ""
