extends Reference
# Frames of a 4-byte big-endian length and that many bytes over TCP: one out, one back, and never a wait in here.
# This file knows nothing about what the bytes say.

const Errors = preload("errors.gd")

enum { CLOSED, CONNECTING, IDLE, SENDING, RECEIVING }

var state := CLOSED
var _socket: StreamPeerTCP
var _out := PoolByteArray()
var _in := PoolByteArray()
var _max_reply_bytes := 0


# Begin to connect; poll() says when that is done. An open socket is closed before.
func open(host: String, port: int) -> Dictionary:
	close()
	if port < 1 or port > 65535:
		return Errors.failure(Errors.CONNECT_FAILED, "port %d, expected 1 to 65535" % port)
	_socket = StreamPeerTCP.new()
	if _socket.connect_to_host(host, port) != OK:
		close()
		return Errors.failure(Errors.CONNECT_FAILED, "no way to %s" % host)
	state = CONNECTING
	return {"ok": true}


# Send a frame as far as the socket lets, and wait for one of at most so many bytes. What came before it was asked for is no reply.
func send(body: PoolByteArray, max_reply_bytes: int) -> Dictionary:
	if state != IDLE:
		return Errors.failure(Errors.CONNECTION_LOST, "the socket is not open")
	if _socket.get_status() != StreamPeerTCP.STATUS_CONNECTED:
		return _lost("the server closed the socket")
	if _socket.get_available_bytes() > 0:
		return _bad("%d bytes came before they were asked for" % _socket.get_available_bytes())
	var prefix := StreamPeerBuffer.new()
	prefix.big_endian = true
	prefix.put_u32(body.size())
	_out = prefix.data_array
	_out.append_array(body)
	_in = PoolByteArray()
	_max_reply_bytes = max_reply_bytes
	state = SENDING
	var failed = _send_some()  # nearly always all of it
	return failed if failed != null else {"ok": true}


# Go on as far as the socket lets. Null: not done. {"ok": true, "body"}: the reply, or {"ok": true}: connected. A failure:
# the socket is closed.
func poll():
	if state == CLOSED or state == IDLE:
		return null
	var status := _socket.get_status()
	if state == CONNECTING:
		return _connected(status)
	if status != StreamPeerTCP.STATUS_CONNECTED:
		return _lost("the server closed the socket after %d bytes of a reply" % _in.size())
	if state == SENDING:
		var failed = _send_some()
		if failed != null or state == SENDING:
			return failed
	return _receive_some()


func close() -> void:
	if _socket != null:
		_socket.disconnect_from_host()
		_socket = null
	state = CLOSED
	_out = PoolByteArray()
	_in = PoolByteArray()


func _connected(status: int):
	if status == StreamPeerTCP.STATUS_CONNECTING:
		return null
	if status != StreamPeerTCP.STATUS_CONNECTED:
		close()
		return Errors.failure(Errors.CONNECT_FAILED, "nobody answered there")
	_socket.set_no_delay(true)
	state = IDLE
	return {"ok": true}


func _send_some():
	var sent := _socket.put_partial_data(_out)
	if sent[0] != OK:
		return _lost("the server closed the socket while a request was sent")
	if sent[1] == _out.size():
		_out = PoolByteArray()
		state = RECEIVING
	elif sent[1] > 0:
		_out = _out.subarray(sent[1], _out.size() - 1)
	return null


func _receive_some():
	if _in.size() < 4:
		var failed = _take(4 - _in.size())
		if failed != null or _in.size() < 4:
			return failed
	var size := _in[0] << 24 | _in[1] << 16 | _in[2] << 8 | _in[3]
	if size > _max_reply_bytes:
		return _bad("the server announces a reply of %d bytes, more than %d" % [size, _max_reply_bytes])
	if _in.size() < 4 + size:
		var failed = _take(4 + size - _in.size())
		if failed != null or _in.size() < 4 + size:
			return failed
	if _socket.get_available_bytes() > 0:
		return _bad("%d bytes follow the reply" % _socket.get_available_bytes())
	var body := _in.subarray(4, 3 + size) if size > 0 else PoolByteArray()
	_in = PoolByteArray()
	state = IDLE
	return {"ok": true, "body": body}


# Read at most so many bytes of those that are there.
func _take(missing: int):
	var there := int(min(missing, _socket.get_available_bytes()))
	if there > 0:
		var read := _socket.get_partial_data(there)
		if read[0] != OK:
			return _lost("the server closed the socket after %d bytes of a reply" % _in.size())
		_in.append_array(read[1])
	return null


func _lost(detail: String) -> Dictionary:
	close()
	return Errors.failure(Errors.CONNECTION_LOST, detail)


func _bad(detail: String) -> Dictionary:
	close()
	return Errors.failure(Errors.BAD_REPLY, detail)
