extends Reference
# The part of msgpack that the protocol uses: nil, bool, int, float, str, bin, array, and map with text keys.
# This file knows nothing about messages or sockets.
#
# Read: any width. Written: the least width of an int, 64 bits of a float. Ints above 2^63 - 1 do not fit GDScript's.


# The bytes of a value: null, bool, int, float, String, PoolByteArray (bin), Array, or Dictionary with String keys.
static func encode(value) -> PoolByteArray:
	var out := StreamPeerBuffer.new()
	out.big_endian = true
	_put(out, value)
	return out.data_array


# {"ok": true, "value"} of one whole value, or {"ok": false, "detail"}; whatever the bytes, never an error of the engine
# and never more memory or depth than they pay for.
static func decode(bytes: PoolByteArray) -> Dictionary:
	var reader := Reader.new(bytes)
	var value = reader.value(0)
	if reader.fault == "" and reader.left() > 0:
		reader.fault = "%d bytes follow the value" % reader.left()
	if reader.fault != "":
		return {"ok": false, "detail": reader.fault}
	return {"ok": true, "value": value}


static func _put(out: StreamPeerBuffer, value) -> void:
	match typeof(value):
		TYPE_INT:
			_put_int(out, value)
		TYPE_REAL:
			out.put_u8(0xcb)
			out.put_double(value)
		TYPE_STRING:
			var text: PoolByteArray = value.to_utf8()
			_put_size(out, text.size(), 0xa0, 32, 0xd9, 0xda)
			_put_bytes(out, text)
		TYPE_RAW_ARRAY:
			_put_size(out, value.size(), 0xc4, 0, 0xc4, 0xc5)
			_put_bytes(out, value)
		TYPE_ARRAY:
			_put_size(out, value.size(), 0x90, 16, 0, 0xdc)
			for each in value:
				_put(out, each)
		TYPE_DICTIONARY:
			_put_size(out, value.size(), 0x80, 16, 0, 0xde)
			for key in value:
				_put(out, key)
				_put(out, value[key])
		TYPE_BOOL:
			out.put_u8(0xc3 if value else 0xc2)
		_:
			out.put_u8(0xc0)


static func _put_int(out: StreamPeerBuffer, value: int) -> void:
	if value >= -32 and value < 0x80:
		out.put_8(value)
	elif value >= 0:
		if value < 0x100:
			out.put_u8(0xcc)
			out.put_u8(value)
		elif value < 0x10000:
			out.put_u8(0xcd)
			out.put_u16(value)
		elif value < 0x100000000:
			out.put_u8(0xce)
			out.put_u32(value)
		else:
			out.put_u8(0xcf)
			out.put_64(value)
	elif value >= -0x80:
		out.put_u8(0xd0)
		out.put_8(value)
	elif value >= -0x8000:
		out.put_u8(0xd1)
		out.put_16(value)
	elif value >= -0x80000000:
		out.put_u8(0xd2)
		out.put_32(value)
	else:
		out.put_u8(0xd3)
		out.put_64(value)


# A length: in the tag itself below `fixed`, else in one byte where there is such a tag (`tag_8`), in two, or in four.
static func _put_size(out: StreamPeerBuffer, size: int, tag: int, fixed: int, tag_8: int, tag_16: int) -> void:
	if size < fixed:
		out.put_u8(tag | size)
	elif tag_8 != 0 and size < 0x100:
		out.put_u8(tag_8)
		out.put_u8(size)
	elif size < 0x10000:
		out.put_u8(tag_16)
		out.put_u16(size)
	else:
		out.put_u8(tag_16 + 1)
		out.put_u32(size)


static func _put_bytes(out: StreamPeerBuffer, bytes: PoolByteArray) -> void:
	if bytes.size() > 0:
		out.put_data(bytes)


class Reader:
	const MAX_DEPTH := 16  # the messages have five

	var fault := ""  # what is wrong with the bytes; once there is something, every value is null
	var _source := StreamPeerBuffer.new()

	func _init(bytes: PoolByteArray) -> void:
		_source.big_endian = true
		_source.data_array = bytes

	func left() -> int:
		return _source.get_available_bytes()

	func value(depth: int):
		if fault != "" or not _has(1):
			return null
		var tag := _source.get_u8()
		if tag < 0x80:
			return tag
		if tag >= 0xe0:
			return tag - 0x100
		if tag < 0x90:
			return _map(tag & 0x0f, depth)
		if tag < 0xa0:
			return _array(tag & 0x0f, depth)
		if tag < 0xc0:
			return _text(tag & 0x1f)
		match tag:
			0xc0:
				return null
			0xc2:
				return false
			0xc3:
				return true
			0xc4, 0xc5, 0xc6:
				return _bytes(_size(tag - 0xc4))
			0xca:
				return _source.get_float() if _has(4) else null
			0xcb:
				return _source.get_double() if _has(8) else null
			0xcc, 0xcd, 0xce:
				return _size(tag - 0xcc)
			0xcf:
				return _unsigned_64()
			0xd0:
				return _source.get_8() if _has(1) else null
			0xd1:
				return _source.get_16() if _has(2) else null
			0xd2:
				return _source.get_32() if _has(4) else null
			0xd3:
				return _source.get_64() if _has(8) else null
			0xd9, 0xda, 0xdb:
				return _text(_size(tag - 0xd9))
			0xdc, 0xdd:
				return _array(_size(tag - 0xdb), depth)
			0xde, 0xdf:
				return _map(_size(tag - 0xdd), depth)
		return _fail("0x%02x begins no value that the protocol uses" % tag)

	func _fail(detail: String):
		if fault == "":
			fault = detail
		return null

	func _has(size: int) -> bool:
		if size > left():
			_fail("%d bytes are left where %d are announced" % [left(), size])
		return fault == ""

	# An unsigned int of 1, 2 or 4 bytes (`width` 0, 1, 2).
	func _size(width: int) -> int:
		if not _has(1 << width):
			return 0
		match width:
			0:
				return _source.get_u8()
			1:
				return _source.get_u16()
		return _source.get_u32()

	func _unsigned_64():
		if not _has(8):
			return null
		var number := _source.get_64()
		return number if number >= 0 else _fail("an int is above 2^63 - 1")

	func _bytes(size: int) -> PoolByteArray:
		if size == 0 or not _has(size):
			return PoolByteArray()
		return _source.get_data(size)[1]

	# What does not come back from a String as it went in is not UTF-8, or has a NUL, which ends a String of the engine.
	func _text(size: int):
		var bytes := _bytes(size)
		var text := bytes.get_string_from_utf8() if bytes.size() > 0 else ""
		return text if text.to_utf8() == bytes else _fail("a text is not UTF-8")

	func _array(size: int, depth: int):
		var values := []
		if depth >= MAX_DEPTH:
			return _fail("nested deeper than %d" % MAX_DEPTH)
		if not _has(size):  # each takes a byte at least
			return null
		for _i in range(size):
			values.append(value(depth + 1))
			if fault != "":
				return null
		return values

	func _map(size: int, depth: int):
		var values := {}
		if depth >= MAX_DEPTH:
			return _fail("nested deeper than %d" % MAX_DEPTH)
		if not _has(2 * size):
			return null
		for _i in range(size):
			var key = value(depth + 1)
			if typeof(key) != TYPE_STRING:
				return _fail("the key of a map is no text")
			values[key] = value(depth + 1)
			if fault != "":
				return null
		return values
