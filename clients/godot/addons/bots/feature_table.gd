extends Reference
# The features of the served bundle, in wire order, as `welcome` names them: F free numbers a bot, M costly features of
# D numbers together. This file knows nothing about rays, requests or sockets.

const MAX_FEATURES := 1024
const MAX_FEATURE_SIZE := 4096
const MAX_COST_US := 1e6
const MAX_NUMBER := 3.4028234663852886e38

var features := []  # each {"name", "size", "cost_us", "low", "high"}
var free := []  # those whose cost is 0: sent every frame
var costly := []  # those that must be asked for; a query names them by their place in here
var sizes := PoolIntArray()  # [M] of the costly ones
var n_free := 0  # F
var n_queries := 0  # M
var n_costly := 0  # D


# Take the list of a `welcome`. Returns "", or what is wrong with it.
func read(listed) -> String:
	if typeof(listed) != TYPE_ARRAY or listed.empty() or listed.size() > MAX_FEATURES:
		return "features are no list of 1 to %d" % MAX_FEATURES
	var names := {}
	for each in listed:
		if not _is_feature(each) or names.has(each["name"]):
			return "no feature, or one of the same name as another: %s" % str(each).left(80)
		names[each["name"]] = true
		features.append(each)
		if each["cost_us"] == 0:
			free.append(each)
			n_free += each["size"]
		else:
			costly.append(each)
			sizes.append(each["size"])
			n_costly += each["size"]
	n_queries = costly.size()
	return ""


static func is_number(value) -> bool:
	return typeof(value) == TYPE_INT or (typeof(value) == TYPE_REAL and not is_nan(value) and not is_inf(value))


# A name as PROTOCOL.md's tables have them: up to 64 of a-z, 0-9 and _, a letter first.
static func is_name(value) -> bool:
	if typeof(value) != TYPE_STRING or value.length() > 64 or not value.is_valid_identifier():
		return false
	return value == value.to_lower() and value[0] != "_"


# Whether two limits are finite as float32, and increasing.
static func is_range(low, high) -> bool:
	return is_number(low) and is_number(high) and -MAX_NUMBER <= low and low < high and high <= MAX_NUMBER


static func is_cost(value) -> bool:
	return is_number(value) and value >= 0 and value <= MAX_COST_US


static func _is_feature(each) -> bool:
	if typeof(each) != TYPE_DICTIONARY or typeof(each.get("size")) != TYPE_INT or not is_name(each.get("name")):
		return false
	if each["size"] < 1 or each["size"] > MAX_FEATURE_SIZE:
		return false
	return is_cost(each.get("cost_us")) and is_range(each.get("low"), each.get("high"))
