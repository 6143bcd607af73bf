extends Reference
# Values as the engine's JSON can carry them without a change: test_godot.py writes and reads the same forms.


static func ints(numbers: Array) -> Array:
	var ints := []
	for number in numbers:
		ints.append(int(number))
	return ints


static func places(rows: Array) -> Array:
	var places := []
	for row in rows:
		var set := PoolIntArray()
		for i in range(row.size()):
			if row[i] == 1:
				set.append(i)
		places.append(set)
	return places


static func rows(base64: String, count: int) -> Array:
	var source := StreamPeerBuffer.new()
	source.data_array = bytes(base64)
	var rows := []
	for _i in range(count):
		var row := []
		for _j in range(source.get_size() / 4 / count):
			row.append(source.get_float())
		rows.append(row)
	return rows


static func bytes(base64: String) -> PoolByteArray:
	return Marshalls.base64_to_raw(base64) if base64 != "" else PoolByteArray()


# A value as JSON can carry it without a change; test_godot.py shows its own in the same way.
static func shown(value):
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
				shown.append(shown(each))
			return shown
		TYPE_DICTIONARY:
			var shown := {}
			for key in value:
				shown[key.to_utf8().hex_encode()] = shown(value[key])
			return shown
	return value
static func codes(replies: Array) -> Array:
	var codes := []
	for reply in replies:
		codes.append("OK" if reply["ok"] else reply["code"])
	return codes
