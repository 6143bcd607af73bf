extends Spatial
# Walkers that ask a server which rays to cast, cast them, and walk as it says:
#
#   python -m server --bundle bundles/hard --tcp-port 8001
#   godot3-server --path clients/godot --host=127.0.0.1 --port=8001 --bots=4 --decisions=30
#
# With --measure=1 the server is told what casting took and keeps budgets by that, not by declared costs. Ends with 0
# when all decisions were made, with 1 where anything failed. No tick of the physics waits for the server.

const Arena = preload("arena.gd")
const BotClient = preload("../addons/bots/bot_client.gd")
const Rays = preload("../addons/bots/rays.gd")
const Walker = preload("walker.gd")

const CLASSES := ["nothing", "ground", "wall", "lava", "water"]
const TICKS := 6  # of the physics, 60 a second, between two decisions

var _client := BotClient.new()
var _rays := Rays.new()
var _walkers := []
var _bots := []
var _asked := []
var _arguments := {"host": "127.0.0.1", "port": "8001", "bots": "4", "decisions": "30", "measure": "0"}
var _frame := 0
var _tick := 0
var _spent_us := 0.0
var _n_rays := 0
var _cast_us := 0


func _ready() -> void:
	for argument in OS.get_cmdline_args():
		var parts: PoolStringArray = argument.trim_prefix("--").split("=")
		if parts.size() == 2 and _arguments.has(parts[0]):
			_arguments[parts[0]] = parts[1]
	add_child(Arena.new())
	_client.timeout_s = 2.0
	var failed := _connect()
	if not failed["ok"]:
		_end(failed)


# Before the game begins it may wait.
func _connect() -> Dictionary:
	var reply := _client.connect_to(_arguments["host"], int(_arguments["port"]))
	if reply["ok"]:
		reply = _client.hello()
	if reply["ok"]:
		reply = _rays.setup(_client.welcome["table"], CLASSES)
	var count := int(_arguments["bots"])
	if reply["ok"]:
		reply = _client.start(count, {"seeds": range(count)})
	if reply["ok"]:
		_bots = reply["bots"]
		_rays.collision_mask = 1
		for i in range(count):
			_walkers.append(Walker.new())
			_walkers[i].translation = Vector3(-8 + 16.0 * (i + 0.5) / count, 0.1, 12)
			_walkers[i].goal = Vector3(10, 0, -20)
			add_child(_walkers[i])
	return reply


func _physics_process(delta: float) -> void:
	if _bots.empty():
		return
	for walker in _walkers:
		walker.walk(delta)
	var reply = _client.poll()
	if reply != null:
		_answered(reply)
	if _tick % TICKS == 0 and not _client.is_waiting() and not _bots.empty():
		_ask()
	_tick += 1


func _ask() -> void:
	var free := []
	for walker in _walkers:
		free.append(walker.free_numbers())
	var begun := _client.begin_query(_bots, _frame, free)
	if not begun["ok"]:
		_end(begun)


func _answered(reply: Dictionary) -> void:
	if reply["ok"] and reply.has("asked"):
		reply = _cast(reply)
	elif reply["ok"]:
		_walk_on(reply)
	if not reply["ok"]:
		_end(reply)


func _cast(queries: Dictionary) -> Dictionary:
	var space := get_world().direct_space_state
	var values := []
	var began_usec := OS.get_ticks_usec()
	for i in range(_bots.size()):
		var walker = _walkers[i]
		values.append(_rays.cast(space, walker.eye(), queries["asked"][i], [walker]))
	var took_us := OS.get_ticks_usec() - began_usec
	_cast_us += took_us
	_asked = queries["asked"]
	for i in range(_bots.size()):
		_n_rays += _asked[i].size()
		_spent_us += queries["cost_us"][i]
	var options := {"acquire_us": took_us} if _arguments["measure"] == "1" else {}
	return _client.begin_act(_bots, _frame, _asked, values, options)


func _walk_on(reply: Dictionary) -> void:
	for i in range(_bots.size()):
		_walkers[i].decide(reply["actions"][i])
	print("frame %d: bot 0 cast %d rays, action %s" % [_frame, _asked[0].size(), reply["actions"][0]])
	_frame += 1
	if _frame == int(_arguments["decisions"]):
		_end({"ok": true})


func _end(result: Dictionary) -> void:
	var welcome = _client.welcome
	if result["ok"]:
		var turns := float(_frame * _bots.size())
		print("%d bots, %d frames: %.1f rays a turn, %.1f us charged of a budget of %.1f, %.1f us by this clock" % [
			_bots.size(), _frame, _n_rays / turns, _spent_us / turns, welcome["budget_us"], _cast_us / turns])
		print("%d replies were late" % _client.n_late)
	else:
		printerr("%s: %s" % [result["code"], result["detail"]])
	_bots = []
	_client.close()
	get_tree().quit(0 if result["ok"] else 1)
