extends Reference
# The features of the served bundle, in wire order, as `welcome` names them: F free numbers a bot, M costly features of
# D numbers together. This file knows nothing about rays, requests or sockets.

const MAX_FEATURES := 1024
const MAX_FEATURE_SIZE := 4096

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


static func _is_feature(each) -> bool:
	if typeof(each) != TYPE_DICTIONARY or typeof(each.get("name")) != TYPE_STRING or typeof(each.get("size")) != TYPE_INT:
		return false
	for name in ["cost_us", "low", "high"]:
		if not is_number(each.get(name)):
			return false
	return (
		each["size"] >= 1
		and each["size"] <= MAX_FEATURE_SIZE
		and each["cost_us"] >= 0
		and each["low"] < each["high"]
	)
